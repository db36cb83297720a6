"""Kernels that are traced from NumPy: the same numbers, or the plain loop and a line that says why."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_numpy import CartPole, Feedback
from interpreted import assert_alike, interpreted, predicted_as_plain
from scipy.interpolate import CubicSpline

import simbias
from simbias.core import FittedBias, Kernel, Model, Nominal
from simbias.core.records import Array
from simbias.learning.bias.none import ZeroBias
from simbias.learning.identification.identified import Identified
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler import points_of
from simbias.simulation.compiler.symbolic_arrays import Symbols
from simbias.simulation.compiler.symbols import MOST, TraceError
from simbias.simulation.compiler.tracing import _knows_foreign_code, of_bias, of_nominal, of_policy
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import PredictionModel, Windows
from simbias.trial.study import Study

RNG = np.random.default_rng(0)
OTHERS = RNG.normal(size=(50, 3)), RNG.normal(size=(50, 3))  # than those of `points`
VALUES = np.array([10.5, 6.8, 0.81, 0.0, 1.0, 9.81])


class Stepping(Nominal):
    """A model whose step is a function."""

    def __init__(self, function: Callable[[Array, Array], Array]) -> None:
        self._function = function

    def step(self, x: Array, u: Array) -> Array:
        return self._function(x, u)


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole", "task.horizon=100", "bias=none", "tracking=none"])


def points() -> tuple[Array, Array]:
    """States and inputs at which a kernel is checked."""
    return RNG.normal(size=(32, 3)), RNG.normal(size=(32, 3))


def expect_the_same(kernel: Kernel, step: Callable[[Array, Array], Array]) -> None:
    """The traced text in Python, at other states than those at which it was checked."""
    with np.errstate(all="ignore"):
        columns = kernel.function(*(tuple(each.T) for each in OTHERS), tuple(kernel.parameters))
        expected = step(*OTHERS)
    for index, column in enumerate(columns):
        np.testing.assert_allclose(np.broadcast_to(column, 50), expected[:, index], rtol=1e-9, atol=1e-12)


A = np.array([[0.0, 1.0, 2.0], [-1.0, 0.5, 0.0], [0.1, 0.2, 0.3]])
SPD = A @ A.T + np.eye(3)


def made_in_place(a: Array, b: Array) -> Array:
    x = a.copy()
    x[..., 1] += 0.5 * b[..., 0]
    x[..., :1] *= b[..., 2:]
    return x


def filled(a: Array, b: Array) -> Array:
    x = np.zeros_like(a)
    x[..., 0], x[..., 1:] = b[..., 1], a[..., :2]
    return x


def counted(a: Array, b: Array) -> Array:
    """Conditions are numbers among numbers and where they are counted; the sum of two is a condition."""
    x = np.zeros_like(a, dtype=float)
    x[..., 0], x[..., 1] = a[..., 0] > 0, b[..., 0] > 0
    total = x[..., :1] + x[..., 1:2] + np.sum([a > 0, b > 0], axis=0) + ((a > 0) & 1) + ((b > 0) ^ 1)
    return total + ((a > 0) + (b > 0)) * b + (np.maximum(a > 0, b > 0) + (a > 1)) * a


def masked(a: Array, b: Array) -> Array:
    """Arrays of conditions take what is written into them for a condition."""
    on, off = np.zeros_like(a, dtype=bool), np.ones_like(a > 0)
    on[..., 0], on[..., 1], off[..., :2] = a[..., 0] > 0, 2, np.where(b > 0, b, 0)[..., :2]
    return np.where(on, a, b) + (on + np.full_like(a, b > 0, dtype=bool)) * off


def solved(a: Array, b: Array) -> Array:
    M = SPD + 0.1 * np.abs(a)[..., None] * np.eye(3)
    return np.linalg.solve(M, b[..., None])[..., 0] + np.einsum("...ij,...j->...i", np.linalg.inv(M), a)


def eliminated(a: Array, b: Array) -> Array:
    rows = np.concatenate([a, b[..., :1]], axis=-1)
    M = rows[..., :, None] * rows[..., None, :] + 3 * np.eye(4)
    return np.linalg.solve(M, np.concatenate([b, a[..., :1]], axis=-1)[..., None])[..., 1:, 0]


OPERATIONS: list[Callable[[Array, Array], Array]] = [
    lambda a, b: a + 2 * b - 1,
    lambda a, b: a * b / (1 + b**2),
    lambda a, b: 1 / (3 + np.sin(a) * np.cos(a)) - b / 7,
    lambda a, b: np.sqrt(np.abs(a)) + np.tanh(b) ** 3 - np.abs(b) ** 0.5,
    lambda a, b: np.exp(-(a**2)) + np.log1p(b * b) + np.expm1(-np.square(b)),
    lambda a, b: np.arctan2(a, b) + np.hypot(a, b) + np.arctan(a),
    lambda a, b: np.where((a > b) & ~(a <= 0) | (b != b), a, -b),
    lambda a, b: np.maximum(a, b) - np.minimum(a, 0.3),
    lambda a, b: np.clip(a, -0.5, 0.5) + (a >= b) * b,
    lambda a, b: np.select([a > 1, b > 1], [a, 0.5 * b], 0.25),
    lambda a, b: (a + np.pi) % (2 * np.pi) - np.pi + np.floor(b),
    lambda a, b: np.sign(a) * np.ceil(b) + np.tan(0.1 * b),
    lambda a, b: a @ A.T + (A @ b[..., None])[..., 0],
    lambda a, b: np.einsum("ij,...j->...i", A, a) + np.dot(b, A),
    lambda a, b: np.cross(a, b),
    lambda a, b: np.stack([a[..., 0], b[..., 1], a[..., 2] * b[..., 0]], axis=-1),
    lambda a, b: np.concatenate([a[..., :1], b[..., 1:]], axis=-1)[..., ::-1],
    lambda a, b: a.sum(axis=-1, keepdims=True) * np.ones(3) + np.cumsum(b, axis=-1),
    lambda a, b: b - a.mean(axis=-1)[..., None] + np.roll(b, 1, axis=-1),
    lambda a, b: a / (1 + np.linalg.norm(b, axis=-1, keepdims=True)),
    lambda a, b: np.moveaxis(np.array([a[..., 0], a[..., 1] - b[..., 2], b[..., 0]]), 0, -1) + 0 * a,
    lambda a, b: np.asarray(a) * a.max(axis=-1, keepdims=True) + b.astype(float).min(axis=-1)[..., None],
    lambda a, b: np.any(a > 1, axis=-1, keepdims=True) * a + np.isfinite(b) * 1.0,
    lambda a, b: np.clip(a, a_min=-0.5, a_max=0.5) + b.clip(max=0.3) + np.clip(a, min=b),
    lambda a, b: np.rint(a) + np.round(b, 1) + np.fix(b) + np.fmod(a, 0.3) + a // 0.3 - b % -0.7,
    lambda a, b: np.fmin(np.sqrt(a), b) + np.fmax(a, np.log(b)) + np.isinf(a / (b > 0)) * b,
    lambda a, b: np.interp(a, [-1, 0, 0, 2], [1, 0, 3, -1]) + np.interp(b, [-1, 1], [1, 2], left=-7, right=9),
    *(made_in_place, filled, counted, masked, solved, eliminated),
]


def test_every_operation_is_traced() -> None:
    for operation in OPERATIONS:
        part = of_nominal(Stepping(operation), points)
        assert part.kernel, part.why_not
        expect_the_same(part.kernel, operation)


def test_periods_and_tables_are_numpys_at_their_edges() -> None:
    """To the last bit: whether a frame begins a period, and what lies at the end of a table or beyond."""
    knots = [0.0, 0.3, 0.7, 1.1]
    for period in (0.1, 0.18, 0.3, 0.6):

        def step(x: Array, u: Array, period: float = period) -> Array:
            t, table = x[..., 0], np.interp(x[..., 0], knots, [0.1, 0.7, -0.3, 0.9])
            turns, share = t / period, (t / period + 0.25) % 1 + np.fmod(-(t / period), 1)
            whole = np.floor(turns) + np.ceil(turns) - np.floor(-turns) + np.floor(2 * turns + 0.5)
            return np.stack([whole + turns // 1, t // period + t % period + turns % 1 + share, table], -1)

        x = np.append(np.append(0.02 * np.arange(-50, 300), knots), [np.inf, -np.inf])[:, None] * np.ones(3)
        part = of_nominal(Stepping(step), points)
        with np.errstate(all="ignore"):
            columns = part.kernel.function(tuple(x.T), tuple(x.T), tuple(part.kernel.parameters))
            np.testing.assert_array_equal(np.transpose(columns), step(x, x))


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, len(OPERATIONS) - 1), st.integers(0, 9), st.integers(0, 9)),
        min_size=1,
        max_size=6,
    )
)
def test_programs_of_them_are_traced(program: list[tuple[int, int, int]]) -> None:
    """Each operation takes two earlier values."""

    def step(x: Array, u: Array) -> Array:
        values = [x, u]
        for operation, first, second in program:
            made = OPERATIONS[operation](values[first % len(values)], values[second % len(values)])
            values.append(np.tanh(made))
        return values[-1]

    part = of_nominal(Stepping(step), points)
    assert part.kernel, part.why_not
    expect_the_same(part.kernel, step)


def test_numbers_change_no_operation(cartpole: Study) -> None:
    """Neither 0 nor 1, nor what is equal; so scenarios run in lockstep, and each loop is compiled once."""
    points = partial(points_of, cartpole.task)
    values = [VALUES, np.ones(6), np.array([1.0, 0.5, 0.5, 0.0, 0.0, 0.0])]
    models = [CartPole(cartpole.task, each) for each in values]
    kernels = [of_nominal(model, points).kernel for model in models]
    assert len({kernel.function for kernel in kernels}) == 1
    assert len({kernel.parameters.tobytes() for kernel in kernels}) == len(values)
    assert of_nominal(models[0], points).kernel is kernels[0]  # it is traced once
    changed = of_nominal(models[0].with_parameters(2 * VALUES), points).kernel
    assert changed.parameters is not kernels[0].parameters


class Counting(Nominal):
    """Depends on how often it was asked."""

    calls = 0

    def step(self, x: Array, u: Array) -> Array:
        self.calls += 1
        return x + self.calls


def into_numbers(x: Array, u: Array) -> Array:
    made = np.zeros(x.shape)
    made[..., 0] = x[..., 0]
    return made


def by_mask(x: Array, u: Array) -> Array:
    made = x.copy()
    made[made > 1] = 1
    return made


WHY: list[tuple[Callable[[Array, Array], Array], str]] = [
    (lambda x, u: x if x[0, 0] > 0 else u, "it branches on a value"),
    (lambda x, u: np.sort(x, axis=-1), "np.sort: it branches on a value"),
    (lambda x, u: np.choose(x > 0, [x, u]), "np.choose of values is not supported"),
    (lambda x, u: np.clip(x, -1, 1, out=np.empty_like(x)), "np.clip: out= is not supported"),
    (lambda x, u: u.clip(-1, out=np.empty_like(x)), "np.clip: out= is not supported"),
    (lambda x, u: u * np.min(x, axis=-1, keepdims=True, initial=9.0), "np.min: np.minimum: initial= is not"),
    (lambda x, u: np.add(x, u, where=np.array(True)), "np.add: where= is not supported"),
    (lambda x, u: x + np.zeros_like(x, int), "np.zeros_like: dtype= is not supported"),
    (lambda x, u: np.interp(x, [0, 1], u[0, :2]), "np.interp: a table of values"),
    (lambda x, u: np.exp(x > 0), "np.exp of conditions is not supported"),
    (into_numbers, "it needs a number"),
    (lambda x, u: CubicSpline(np.arange(9), np.arange(9) ** 2)(x), "it needs a number"),
    (by_mask, "IndexError: "),
    (
        lambda x, u: x + x.mean(axis=0),
        "for several rollouts at once it gives other numbers than",
    ),
    (lambda x, u: x + (x.dtype == float), "its compiled form gives other numbers"),
    (lambda x, u: x + sum(np.sin(x + u + i) for i in range(MOST)), f"it takes more than {MOST} operations"),
    (lambda x, u: x + np.interp(x[..., :1], np.arange(180), np.arange(180)), r"it needs \d+ constants or"),
    (lambda x, u: x + np.random.default_rng().normal(size=3), "it gives other numbers when it is called"),
    (lambda x, u: {}["mass"], "KeyError: 'mass'"),
    (lambda x, u: x / (u - u), "its values are not finite at most states"),
    (lambda x, u: x[..., :2], r"for one row it gives the shape \(1, 2\), not \(1, 3\)"),
    (lambda x, u: np.frexp(x)[0], "np.frexp of values is not supported"),
    (lambda x, u: x.astype(int), "it turns values into whole numbers, conditions or single precision"),
    (lambda x, u: (x * 1j).imag, "it computes with complex numbers"),
]


def test_what_only_numpy_can_run_says_why() -> None:
    for step, why in WHY:
        part = of_nominal(Stepping(step), points)
        assert part.kernel is None, why
        assert re.match(rf"Stepping.step \(test_tracing.py:\d+: {why}", part.why_not), part.why_not


def test_what_a_model_remembers_of_the_attempt_is_forgotten() -> None:
    model = Counting()
    assert "it gives other numbers when it is called again" in of_nominal(model, points).why_not
    assert model.calls == 0


def test_memory_of_an_array_goes_to_no_other_code() -> None:
    """An engine would read addresses for numbers, and write numbers over them."""
    import ctypes  # not at the top: of a module that knows it, nothing is traced

    ways: list[Callable[[Array], Any]] = [
        lambda x: x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)),
        lambda x: (ctypes.c_double * 3).from_buffer(x.data),
        lambda x: np.ascontiguousarray(x, np.float64).ctypes.data,
        lambda x: np.ctypeslib.as_ctypes(x),
        lambda x: np.frombuffer(x.tobytes()),
    ]
    asked = []

    def step(x: Array, u: Array) -> Array:
        if isinstance(x, Symbols):
            for way in ways:
                with pytest.raises((TraceError, TypeError, ValueError)):
                    way(x)
                asked.append(way)
        return x + u

    of_nominal(Stepping(step), points)
    assert asked


def test_modules_that_know_ctypes_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    import ctypes

    class Engine(Stepping):
        def with_parameters(self, values: Array) -> Nominal:
            return self

    def identified() -> Nominal:
        return Identified(Engine(lambda x, u: x + u), np.zeros(0), np.zeros((0, 0)), {})

    assert of_nominal(identified(), points).kernel is not None
    for value in (ctypes, ctypes.CDLL, ctypes.CDLL(None), ctypes.CDLL(None).abs, ctypes.POINTER):
        monkeypatch.setitem(globals(), "library", value)
        _knows_foreign_code.cache_clear()
        assert of_nominal(identified(), points).kernel is None, value
    part = of_nominal(Engine(lambda x, u: x + u), points)
    _knows_foreign_code.cache_clear()
    assert "its module calls code by ctypes" in part.why_not


class Remembers(Nominal):
    """What it keeps of the last input."""

    state_size = 3

    def step(self, x: Array, u: Array) -> Array:
        return x + 0.1 * u

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        return x + 0.1 * (memory + u) / 2, u


def test_models_and_policies_with_memory_are_traced() -> None:
    part = of_nominal(Remembers(), points)
    assert part.kernel, part.why_not
    made, kept = part.kernel.function(
        (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), tuple(part.kernel.parameters), (0.0, 1.0, 0.0)
    )
    np.testing.assert_allclose(made, [1.2, 2.3, 3.3])
    assert kept == (4.0, 5.0, 6.0)


class Corrects(FittedBias):
    def __init__(self) -> None:
        self.weights = 0.1 * A

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        return np.zeros((len(inputs), 3)), np.ones((len(inputs), 3))

    def correction(self, x: Array, u: Array) -> Array:
        return np.tanh(x) @ self.weights


def test_a_bias_of_ones_own_is_traced() -> None:
    bias = Corrects()
    part = of_bias(bias, points)
    assert part.kernel, part.why_not
    expect_the_same(part.kernel, bias.correction)


class Later(Feedback):
    """From half a second on, and smoothly."""

    state_size = 1

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        u, _ = super().act(theta, x, t, memory)
        smooth = memory + 0.1 * (u - memory)
        return smooth * np.where(t >= 0.5, 1.0, 0.0), smooth


def test_what_thetas_alone_decide_is_computed_once(cartpole: Study) -> None:
    """The exponentials of the gains are not in the loop."""
    for policy in (Feedback, Later):
        part = of_policy(policy(cartpole.task), cartpole.task, partial(points_of, cartpole.task))
        assert part.kernel, part.why_not
        thetas = RNG.normal(size=(5, 4))
        gains = np.sign(thetas) * np.expm1(np.abs(thetas))
        np.testing.assert_allclose(part.kernel.parameters(thetas), gains, rtol=1e-12)
        assert "expm1" not in part.kernel.function.__code__.co_names


def test_a_traced_loop_is_the_plain_one(cartpole: Study) -> None:
    """All of it but the declared task, in two scenarios in lockstep; `test_closed_loop.py` compiles one."""
    task = cartpole.task
    nominal = CartPole(task, VALUES)
    first = Model(task, Later(task), nominal, ZeroBias(4))
    models = [first, replace(first, nominal=nominal.with_parameters(1.2 * VALUES))]
    thetas = np.array([1.0, 4.0, 1.0, 2.0]) + RNG.normal(size=(24, 4))
    starts, scenarios = np.array([task.draw_start(RNG) for _ in thetas]), RNG.integers(0, 2, 24)
    together = join([simulator(model) for model in models])
    assert isinstance(together, CompiledSimulator)
    reference = PlainSimulator(models, [None, None])
    with interpreted():
        made, expected = (loop.rollouts(thetas, starts, scenarios) for loop in (together, reference))
    assert len({rollout.frames for rollout in made}) > 3
    assert_alike(made, expected, 1e-9, 1e-9, of_inputs=1e-8)


@pytest.mark.usefixtures("uncompiled")
def test_a_traced_model_predicts_recordings_as_the_plain_one(cartpole: Study) -> None:
    nominal = CartPole(cartpole.task, VALUES)
    windows = Windows.of([cartpole.simulate(np.ones(4))], 5, 5)
    scenarios = [PredictionModel(nominal), PredictionModel(nominal.with_parameters(1.2 * VALUES))]
    predicted_as_plain(scenarios, windows, 1e-9, 1e-12)
