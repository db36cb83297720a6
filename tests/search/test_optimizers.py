"""Every optimizer of conf/optimizer, and every algorithm of NLopt's that may be named there."""

import gc
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from conftest import ROOT
from errors import one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from shipped import shipped

from simbias.config.build import construct
from simbias.core import Objective, Optimizer
from simbias.core.evaluations import EVALUATION_LIMIT, RELATIVE_TOLERANCE, Evaluations
from simbias.core.records import Array, Optimum
from simbias.search.optimizer.nlopt import Algorithm

SHIPPED = sorted(path.stem for path in (ROOT / "conf" / "optimizer").glob("*.yaml"))
CONFIGS = {name: shipped("optimizer", name) for name in SHIPPED}
OTHERS = {*get_args(Algorithm)} - {config.get("algorithm") for config in CONFIGS.values()}
CONFIGS |= {name: {**CONFIGS["nlopt_direct"], "algorithm": name} for name in sorted(OTHERS)}
BOX = np.full(5, -10.0), np.full(5, 10.0)


def make(name: str, **changes: Any) -> Optimizer:
    """The optimizer of a YAML or of one of NLopt's algorithms, some of its arguments changed."""
    return construct({**CONFIGS[name], **changes}, Optimizer, "optimizer")


SHIFT = np.array([1.2, -3.4, 5.6, -7.8, 2.2])
HARTMANN_A = np.array(
    [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14],
     [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
)  # fmt: skip
HARTMANN_P = 1e-4 * np.array(
    [[1312, 1696, 5569, 124, 8283, 5886], [2329, 4135, 8307, 3736, 1004, 9991],
     [2348, 1451, 3522, 2883, 3047, 6650], [4047, 8828, 8732, 5743, 1091, 381]]
)  # fmt: skip


def sphere(x: Array) -> float:
    return 1.0 + float(np.sum((x - SHIFT) ** 2))


def branin(x: Array) -> float:
    """Dixon and Szego, Towards Global Optimisation 2 (1978), p. 1."""
    curve = x[1] - 5.1 / (4 * np.pi**2) * x[0] ** 2 + 5 / np.pi * x[0] - 6
    return float(curve**2 + 10 * (1 - 1 / (8 * np.pi)) * np.cos(x[0]) + 10)


def hartmann6(x: Array) -> float:
    """Dixon and Szego, as Branin's."""
    squares = np.sum(HARTMANN_A * (x - HARTMANN_P) ** 2, axis=1)
    return -float(np.array([1.0, 1.2, 3.0, 3.2]) @ np.exp(-squares))


def rosenbrock(x: Array) -> float:
    """Rosenbrock, The Computer Journal 3 (1960), p. 175."""
    return float(100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2)


# objective, lower, upper, minimum as in Surjanovic and Bingham, https://www.sfu.ca/~ssurjano/optimization.html
PROBLEMS = {
    "sphere": (sphere, [-10.0] * 5, [10.0] * 5, 1.0),
    "branin": (branin, [-5.0, 0.0], [10.0, 15.0], 0.397887),
    "hartmann6": (hartmann6, [0.0] * 6, [1.0] * 6, -3.32237),
    "rosenbrock": (rosenbrock, [-5.0] * 2, [10.0] * 2, 0.0),
}


def minimize(
    optimizer: Optimizer,
    objective: Callable[[Array], float],
    lower: Any,
    upper: Any,
    seed: int = 0,
    target_cost: float = np.inf,
    candidates: Sequence[Array] = (),
) -> Optimum:
    rng = np.random.default_rng(seed)
    return optimizer.minimize(objective, np.array(lower), np.array(upper), rng, target_cost, candidates)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("cma", {"branin": 2, "rosenbrock": 2, "hartmann6": 1}),  # whose second-best is wide
        ("hybrid", {"branin": 2, "rosenbrock": 2, "hartmann6": 1}),
        ("nlopt_crs", {"sphere": 2, "branin": 1}),  # a chance improvement below the tolerance ends CRS2 early
    ],
)
def test_random_search_finds_known_minimum(name: str, least: dict[str, int]) -> None:
    """In at least this many of 2 seeds."""
    optimizer = make(name, max_evaluations=6000, relative_tolerance=1e-8)
    for problem, at_least in least.items():
        objective, lower, upper, minimum = PROBLEMS[problem]
        costs = [minimize(optimizer, objective, lower, upper, seed).cost for seed in range(2)]
        found = sum(cost == pytest.approx(minimum, rel=1e-4, abs=1e-4) for cost in costs)
        assert found >= at_least, problem


def test_direct_finds_known_minimum() -> None:
    """To 0.01% in as many evaluations as D. Jones et al., J. Optim. Theory Appl. 79 (1993), p. 157.

    They count whole divisions, here the evaluation itself is counted.
    """
    for problem, published in (("branin", 195), ("hartmann6", 571)):
        objective, lower, upper, minimum = PROBLEMS[problem]
        watched = Watched(objective)
        minimize(make("GN_ORIG_DIRECT", relative_tolerance=1e-9), watched, lower, upper)
        reached = next(i for i, cost in enumerate(watched.costs, 1) if cost - minimum < 1e-4 * abs(minimum))
        assert 0.97 * published < reached <= published


class Watched:
    """An objective that remembers what it was asked, and changes its argument as it may."""

    def __init__(self, objective: Callable[[Array], float]) -> None:
        self.objective = objective
        self.points: list[Array] = []
        self.costs: list[float] = []

    def __call__(self, x: Array) -> float:
        self.points.append(x.copy())
        self.costs.append(self.objective(x))
        x[:] = np.nan
        return self.costs[-1]


def global_state() -> str:
    return str(np.random.get_state(legacy=False))  # noqa: NPY002


@st.composite
def boxes(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """A box of 1 to 4 dimensions and a point that may lie on its faces or outside."""
    n = draw(st.integers(1, 4))
    lower = np.array(draw(st.lists(st.floats(-1e3, 1e3), min_size=n, max_size=n)))
    width = np.array(draw(st.lists(st.floats(1e-3, 1e3), min_size=n, max_size=n)))
    target = lower + width * draw(st.lists(st.floats(-0.2, 1.2), min_size=n, max_size=n))
    return lower, lower + width, target


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGS)
@settings(max_examples=4, deadline=None)
@given(box=boxes(), limit=st.integers(1, 150), seed=st.integers(0, 2**32))
def test_contract(name: str, box: tuple[Array, Array, Array], limit: int, seed: int) -> None:
    lower, upper, target = box
    watched, again = (
        Watched(lambda x: float(np.sum(((x - target) / (upper - lower)) ** 2))) for _ in range(2)
    )
    before = global_state()
    optimum = minimize(make(name, max_evaluations=limit), watched, lower, upper, seed)
    deterministic = "direct" in name.lower() and "RAND" not in name  # whatever the seed
    minimize(make(name, max_evaluations=limit), again, lower, upper, seed + deterministic)
    assert np.array_equal(watched.points, again.points)
    assert optimum.evaluations == len(watched.costs) <= limit
    assert all((lower <= x).all() and (x <= upper).all() for x in watched.points)
    assert optimum.cost == min(watched.costs)
    assert optimum.parameters.tolist() == watched.points[int(np.argmin(watched.costs))].tolist()
    assert optimum.stopped_by
    assert optimum.evaluations == limit or optimum.stopped_by != EVALUATION_LIMIT
    assert global_state() == before


def test_exceptions_reach_the_caller_at_once() -> None:
    for name in SHIPPED:
        for evaluation, error in enumerate((RuntimeError("broken"), KeyboardInterrupt(), StopIteration()), 1):
            calls: list[Array] = []

            def failing(x: Array, calls=calls, evaluation=evaluation, error=error) -> float:
                calls.append(x)
                if len(calls) >= evaluation:
                    raise error
                return sphere(x)

            for objective in (failing, Together(failing)):
                calls.clear()
                with pytest.raises(type(error)) as caught:
                    minimize(make(name), objective, *BOX)
                assert caught.value is error
                assert len(calls) == evaluation


def test_more_parameters_than_an_algorithm_takes_are_one_line() -> None:
    hybrid = make("hybrid", exploration="sobol")
    for optimizer, p, message in (
        (make("GN_ORIG_DIRECT", max_evaluations=10), 1000, "^optimizer: GN_ORIG_DIRECT fails with 1000 para"),
        (hybrid, 21_202, "^optimizer.exploration: sobol takes at most 21201 parameters, got 21202"),
    ):
        with one_line(message):
            minimize(optimizer, lambda x: 1.0, -np.ones(p), np.ones(p), target_cost=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_relative_tolerance_stops(name: str) -> None:
    """After an improvement that is small, and the finer it is, the later; a plateau is no convergence.

    Neither where nothing improves, nor where all fall: costs of Eq. 8 near 7e5 that hardly differ.
    """
    box, optima = ([-5.0, 0.0], [10.0, 15.0]), []
    for tolerance in (1e-2, 1e-7):
        watched = Watched(branin)
        optimizer = make(name, max_evaluations=5000, relative_tolerance=tolerance)
        optima.append(minimize(optimizer, watched, *box))
        best = np.minimum.accumulate(watched.costs)
        before = best[np.flatnonzero(np.diff(best))[-1]]
        assert optima[-1].stopped_by == RELATIVE_TOLERANCE
        assert 0 < before - best[-1] < tolerance * abs(best[-1])
    coarse, fine = optima
    assert coarse.evaluations < fine.evaluations < 5000
    assert fine.cost <= coarse.cost
    flat = minimize(make(name, max_evaluations=100), lambda x: 7.0, *BOX)
    assert flat.cost == 7.0
    assert flat.stopped_by != RELATIVE_TOLERANCE
    plateau = lambda x: 7e5 + 1e-3 * sphere(x)  # noqa: E731
    most = {"max_evaluations": 1000}
    converged, continued = (
        minimize(make(name, **most), plateau, *BOX, target_cost=z) for z in (np.inf, 200.0)
    )
    assert converged.stopped_by == RELATIVE_TOLERANCE
    assert continued.stopped_by != RELATIVE_TOLERANCE
    assert converged.evaluations < continued.evaluations


def test_cma_is_silent_and_writes_nothing(
    folder: Path,
    capfd: pytest.CaptureFixture[str],
    recwarn: pytest.WarningsRecorder,
) -> None:
    """And reads no file of signals from the folder where it runs."""
    (folder / "cma_signals.in").write_text("{'maxiter': 1}")
    cma = make("cma", initial_deviation=0.25, max_evaluations=1000)
    cliff = lambda x: float(1e6 * (x[0] > 0) + np.sum(x**2))  # noqa: E731
    assert minimize(cma, cliff, -np.ones(5), np.ones(5)).evaluations > 100
    assert (capfd.readouterr(), list(recwarn)) == (("", ""), [])
    assert [path.name for path in folder.iterdir()] == ["cma_signals.in"]


def narrow(x: Array) -> float:
    """Below 200 only near a point, elsewhere a plateau of failures as Eq. 8's: 200 for each lost frame."""
    distance = float(np.linalg.norm(x - SHIFT))
    return 1.0 + distance**2 if distance < 1.0 else 200.0 * np.ceil(100 * distance)


@pytest.mark.parametrize("name", ["cma", "hybrid"])
def test_local_search_starts_from_the_best_candidate(name: str) -> None:
    """The centre of 200 points is nearer to it than the box's centre, and the search converges there."""
    watched = Watched(narrow)
    optimizer = make(name, initial_deviation=0.01, max_evaluations=202)
    candidates = [np.full(5, -9.0), SHIFT + 0.3]
    optimum = minimize(optimizer, watched, *BOX, target_cost=200.0, candidates=candidates)
    np.testing.assert_allclose(np.mean(watched.points[2:], axis=0), SHIFT, atol=0.3)
    assert optimum.cost < narrow(SHIFT + 0.3)


def two_valleys(x: Array) -> float:
    """Failures but for a narrow valley; a wide one of failures leads away from it."""
    wide = 1000.0 + 200.0 * np.ceil(10 * np.linalg.norm(x - 4.0))
    distance = float(np.linalg.norm(x + 7.0))
    return 1.0 + distance**2 if distance < 4.0 else float(wide)


@pytest.mark.slow
def test_restarts_leave_a_valley_of_failures() -> None:
    """In all of 3 seeds, where CMA-ES alone finds the way out in none."""
    costs = {
        name: [
            minimize(make(name, max_evaluations=6000), two_valleys, [-10.0] * 3, [10.0] * 3, seed, 200.0).cost
            for seed in range(3)
        ]
        for name in ("cma", "hybrid")
    }
    assert min(costs["cma"]) > 2.0 > max(costs["hybrid"])


def test_hybrid_turns_local_once_below_the_target() -> None:
    """From the first cost below it on, it stays near the best point."""
    watched = Watched(narrow)
    options = {"explorations": 3000, "initial_deviation": 0.01, "population": None, "resolution": 0.001}
    optimizer = make("hybrid", exploration="GN_CRS2_LM", **options)
    optimum = minimize(optimizer, watched, *BOX, target_cost=200.0)
    first = next(i for i, cost in enumerate(watched.costs) if cost < 200.0)
    after = np.linalg.norm(np.array(watched.points[first:]) - watched.points[first], axis=1)
    assert 10 < first < 3000
    assert optimum.stopped_by == RELATIVE_TOLERANCE
    assert optimum.cost == pytest.approx(1.0, abs=1e-3)
    assert np.max(after) < 2.0


def test_hybrid_may_begin_near_a_candidate_that_fails() -> None:
    """With a deviation for that: it goes down the plateaus; else it explores."""

    def distances(candidate_deviation: float | None) -> Array:
        watched, candidate = Watched(narrow), SHIFT + 1.0
        optimizer = make("hybrid", max_evaluations=40, candidate_deviation=candidate_deviation)
        minimize(optimizer, watched, *BOX, target_cost=200.0, candidates=[candidate])
        return np.linalg.norm(np.array(watched.points[1:]) - candidate, axis=1)

    assert distances(0.01).max() < 3.0 < np.median(distances(None))


class Together(Objective):
    """An objective whose points may be asked for at once; it is looked ahead."""

    def __init__(self, cost: Callable[[Array], float]) -> None:
        self._cost = cost

    def together(self, thetas: Array) -> Array:
        return np.array([self._cost(theta) for theta in thetas])


def test_searches_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """NLopt holds what it calls where the garbage collector does not see it: it must not hold a search."""
    begin, made = Evaluations.__init__, []
    gc.freeze()  # what other tests have left is not looked through

    def noted(self: Evaluations, *arguments: Any, **named: Any) -> None:
        made.append(weakref.ref(self))
        begin(self, *arguments, **named)

    monkeypatch.setattr(Evaluations, "__init__", noted)
    for _ in range(3):
        minimize(make("nlopt_direct", max_evaluations=300), Together(sphere), *BOX)
    gc.collect()
    assert len(made) >= 3
    assert not any(each() for each in made)


class ShiftedSphere(Objective):
    """A sphere that each generation meets elsewhere: its optimum deviates by 1 in each dimension."""

    fresh = True

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def together(self, thetas: Array) -> Array:
        return np.array([sphere(theta) for theta in thetas])

    def rank(self, thetas: Array) -> Array:
        return self.together(thetas + self._rng.standard_normal(5))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cma", "hybrid"])
def test_fresh_scenarios_in_each_generation_lead_to_the_known_optimum(name: str) -> None:
    """The best mean is found, the same by seed, and better than what the last scenarios alone say."""

    def optimum(seed: int) -> Optimum:
        return minimize(make(name, max_evaluations=2000), ShiftedSphere(seed), *BOX, seed, 50.0)

    first, again, other = optimum(0), optimum(0), optimum(1)
    np.testing.assert_array_equal(first.parameters, again.parameters)
    assert first.evaluations == again.evaluations <= 2000
    assert (first.parameters != other.parameters).any()
    for each in (first, other):
        assert each.cost == sphere(each.parameters) < 1.0 + 5 / 4  # a generation's own optimum is 5 away


class Funnel(Objective):
    """A funnel around the optimum, flat outside of its radius; it may have a wider one as a first stage."""

    def __init__(self, radius: float, first_stage: Objective | None = None) -> None:
        self.radius, self.first_stage, self.asked = radius, first_stage, 0

    def together(self, thetas: Array) -> Array:
        self.asked += len(thetas)
        return np.minimum(1.0, np.linalg.norm(thetas - SHIFT, axis=1) / self.radius)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cma", "hybrid"])
def test_a_search_begins_where_its_first_stage_ended(name: str) -> None:
    """It ended at its first cost below the target, which is within the funnel, or as any search does."""
    assert minimize(make(name), Funnel(1.5), *BOX, target_cost=0.1).cost == 1.0
    wide = Funnel(15.0)
    funnel = Funnel(1.5, wide)
    near = {"hybrid": {"candidate_deviation": 0.02}, "cma": {"initial_deviation": 0.02}}[name]
    optimum = minimize(make(name, **near), funnel, *BOX, target_cost=0.1)
    assert optimum.cost < 1e-3
    assert 0 < optimum.evaluations - funnel.asked <= wide.asked  # the last generation is asked for together
    assert minimize(make(name, **near), Funnel(1.5, Funnel(15.0)), *BOX).cost < 1e-3
