"""The controller of a request is the policy, in C and in Python."""

import ast
import re
import shutil
import subprocess
from dataclasses import replace
from itertools import product
from pathlib import Path
from platform import machine
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_mass import PointMass

from simbias.core import Policy, Quantity, Task
from simbias.core.records import Array
from simbias.lab.requests import controller as templates
from simbias.lab.requests import verification
from simbias.lab.requests.controller import c_header, harmless, python_module
from simbias.lab.requests.folder import files
from simbias.lab.requests.request import HEADER, MODULE, ExperimentRequest
from simbias.lab.requests.verification import difference
from simbias.lab.safety import Bounds, Safety, SafetyLimitedPolicy, UnsafeError
from simbias.policy.dynamic_output_feedback import DynamicOutputFeedback
from simbias.simulation.compiler import formulas_of
from simbias.trial.study import Study

COMPILER = shutil.which("cc")
THETA = np.array([1.0, -2.0, 3.0, 0.5, -1.0])
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-O2"]


class Integral(Policy):
    """A law with a state that depends on time, as somebody writes it."""

    n_parameters = 1
    state_size = 1
    bounds = (np.zeros(1), np.ones(1))

    def __init__(self, task: Task) -> None:
        self._task = task

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        total = policy_state + x[..., :1]
        u = -theta * total * t + np.sign(x[..., 1:]) * np.sqrt(np.abs(x[..., 1:]))
        return np.clip(u, *self._task.input_bounds), total


class Halved(Integral):
    """Half of another law, which it knows by the name that a limited policy has it by."""

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self.policy = Integral(task)

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        u, policy_state = self.policy.act(theta, x, t, policy_state)
        return 0.5 * u, policy_state


class Branching(Integral):
    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return (x[..., :1] if x[..., 0] > 0 else -x[..., :1]), policy_state


class SignsOfZeros(Integral):
    """The signs of zeros that extremes take: copysign makes them a force."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        a, b = 0.0 * x[..., :1], 0.0 * x[..., 1:]  # zeros with the signs of x
        extremes = [f(*pair) for f in (np.maximum, np.minimum) for pair in ((a, b), (b, a))]
        for known in (0.0, -0.0):
            extremes += [np.maximum(a, known), np.maximum(known, a), np.clip(a, known, 1.0)]
            extremes += [np.minimum(a, known), np.minimum(known, a), np.clip(a, -1.0, known)]
        u = sum(2.0**-i * np.copysign(1.0, extreme) for i, extreme in enumerate(extremes))
        return np.asarray(u), policy_state


class Periodic(Integral):
    """A square wave and stairs, of periods that begin in frames, and a quantised look-up table."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        wave = np.where(t % 0.6 < 0.3, 1.0, -1.0) + 0.1 * (t // 0.1) - 0.1 * np.floor(t / 0.3)
        return wave + np.interp(np.round(x[..., :1], 1), [-1.0, 0.0, 0.5], [0.2, -0.1, 0.3]), policy_state


def controller(made: str | ExperimentRequest) -> Any:
    """The controller of a module in Python, or of a request's."""
    names: dict[str, Any] = {}
    exec(made if isinstance(made, str) else made.code("a test")[MODULE], names)
    return names["Controller"]()


def of_mass(law: type[Integral], theta: float = 0.0) -> ExperimentRequest:
    """Of a law of the point mass."""
    task = PointMass()
    return ExperimentRequest(task, law(task), np.array([theta]), task.start_mean)


def bounds_of(task: Task, states: float = np.inf) -> Bounds:
    """The limits of a task's inputs, and one of all states."""
    return Bounds(task.input_bounds, np.full(1, np.inf), np.full(2, states), False)


def code(policy: Policy, task: Task, theta: Array, bounds: Bounds) -> tuple[str, str]:
    """A policy in C and Python, whether it agrees or not."""
    law = formulas_of(policy, task, theta)
    assert not isinstance(law, str)
    return c_header(task, law, "", bounds), python_module(task, law, "", bounds)


def with_everything(study: Study) -> ExperimentRequest:
    """Of feedback with all that it can remember."""
    options = {"filter_seconds": 0.02, "integral_rate": 2.0, "delay_seconds": 0.004, "constant": 0.1}
    policy = DynamicOutputFeedback(study.task, **options)  # type: ignore[arg-type]
    theta = np.array([*THETA, 0.01, 1.0, -20.0, 3.0])
    return ExperimentRequest(study.task, policy, theta, study.task.start_mean)


@pytest.mark.slow
def test_the_code_is_the_policy_over_hundreds_of_frames(study: Study) -> None:
    """In Python and C; at limits, with state and time, after what is no number, of zeros that are equal."""
    halved = of_mass(Halved, 3.0)
    assert halved.content()["policy"]["class"] == "Halved"
    own = of_mass(Integral, 3.0), of_mass(SignsOfZeros), of_mass(Periodic), halved
    for request in (with_everything(study), *own):
        assert request.why_no_code == ""
        assert {HEADER, MODULE} <= files(request).keys()
    states = 0.3 * np.random.default_rng(0).standard_normal((50, 6))
    request = ExperimentRequest(study.task, study.policy, THETA, study.task.start_mean)
    control = controller(request)
    expected = study.policy.act(THETA, states, 0.0, np.zeros((50, 0)))[0]
    np.testing.assert_allclose([control(x) for x in states], expected, rtol=1e-12, atol=1e-12)
    assert 0.0 < np.abs(expected).max() < 100.0  # none is cut off


def test_after_what_is_no_number_it_stays_aborted(study: Study) -> None:
    """And nothing of it is remembered."""
    control = controller(with_everything(study))
    fine = study.task.start_mean
    control(fine)
    before = control.policy_state.copy()
    with pytest.raises(ValueError, match="abort: unsafe_state_alpha_w: x = "):
        control(np.full(6, np.nan))
    with pytest.raises(ValueError, match="abort: unsafe_state_alpha_w"):
        control(fine)
    np.testing.assert_array_equal(control.policy_state, before)


@pytest.mark.parametrize("wrong", [[0.0] * 5, [0.0] * 7, [[0.0], [0.0, 0.0]], None, "x"], ids=str)
def test_after_a_state_of_wrong_shape_it_stays_aborted(wrong: Any, study: Study) -> None:
    request = with_everything(study)
    for control in (controller(request), request.controller()):
        with pytest.raises(ValueError, match=r"reshape|shape|convert"):
            control(wrong)
        with pytest.raises((ValueError, UnsafeError), match="not_a_number"):
            control(study.task.start_mean)


def test_a_controller_may_run_for_longer_than_an_experiment() -> None:
    request = of_mass(Integral)
    control = request.controller()
    for _ in range(2 * request.task.horizon):
        control(np.zeros(2))
    np.testing.assert_array_equal(control.policy_state, [0.0])


def test_the_request_controller_aborts_without_a_limit_as_the_code_does(study: Study) -> None:
    control = with_everything(study).controller()
    control(study.task.start_mean)
    for x in (np.full(6, np.nan), study.task.start_mean):
        with pytest.raises(UnsafeError, match="unsafe_state_alpha_w"):
            control(x)


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_the_header_compiles_without_a_warning_and_refuses_fast_mathematics(
    study: Study, tmp_path: Path
) -> None:
    (tmp_path / "main.c").write_text(
        '#include <string.h>\n#include "controller.h"\n'
        "int main(void) { simbias_controller c; double x[8] = {0}, u[2]; simbias_start(&c);\n"
        "if (simbias_control(&c, x, u)) return 1;\nx[1] = NAN;\n"
        'return !simbias_control(&c, x, u) || strncmp(c.failure, "unsafe_state_", 13); }\n'
    )
    assert COMPILER is not None
    for request in (of_mass(Integral, 3.0), with_everything(study)):
        (tmp_path / "controller.h").write_text(request.code('a "*/ test')[HEADER])
        command = [COMPILER, *STRICT, "-o", tmp_path / "main", tmp_path / "main.c", "-lm"]
        subprocess.run(command, check=True)
        assert subprocess.run([tmp_path / "main"]).returncode == 0
    fast = subprocess.run([*command, "-ffast-math"], capture_output=True, text=True)
    assert fast.returncode
    assert "without -ffast-math" in fast.stderr


class Different(ExperimentRequest):
    why_no_code = "in C, frame 3 gives something else"


@pytest.mark.slow
def test_code_that_is_not_the_policy_is_not_written() -> None:
    """Whichever of the two it is; a line says so."""
    request = of_mass(Integral, 3.0)
    right = request.code("")
    for name, language in ((MODULE, "Python"), (HEADER, "C")):
        if language == "C" and COMPILER is None:
            continue
        wrong = right | {name: right[name].replace("(-3.0)", "(-3.001)")}
        assert wrong != right
        written = wrong[HEADER], wrong[MODULE]
        said = difference(request.policy, request.task, request.theta, request.bounds, *written)
        assert said.startswith(f"in {language}, frame ")
    made = files(Different(request.task, request.policy, request.theta, request.start))
    assert not {HEADER, MODULE} & made.keys()
    said = f"This policy cannot be written out as code ({Different.why_no_code})"
    assert said in " ".join(made["README.txt"].split())


def test_code_is_held_against_the_policy_after_an_abort_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose own frame, and the one after it, are aborted."""
    task = PointMass()
    states = np.repeat([[2.0, 0.0], [0.1, 0.2]], 2, axis=0)
    monkeypatch.setattr(verification, "_sequences", lambda task: [states])
    law = SignsOfZeros(task), task, np.zeros(1), bounds_of(task, 1.0)
    header, module = code(*law)
    assert difference(*law, header, module) == ""
    said = difference(*law, header, module.replace("0.5 * ", "0.25 * "))
    assert said.startswith("in Python, frame 2 gives abort, u = [0.0, ")


def test_code_is_held_against_the_policy_after_the_horizon_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """If it depends on time, whatever limits would end it before."""

    class Limited(ExperimentRequest):
        bounds = replace(bounds_of(PointMass(horizon=250), 0.1), input_rates=np.full(1, 1e-3))

    task = PointMass(horizon=250)
    request = Limited(task, Integral(task), np.array([0.01]), task.start_mean)
    stopped = templates.MODULE.replace("self.frame *", "min(self.frame, 270) *")
    monkeypatch.setattr(templates, "MODULE", stopped)
    assert request.why_no_code.startswith("in Python, frame 271 gives")


LOOKED_UP = """
int main(void)
{
    static double column[128];
    for (int rows = 2; rows < 127; ++rows)
        for (int horizon = rows; horizon < 500; ++horizon) {
            const double spacing = horizon * 0.02 / (rows - 1);
            for (int i = 0; i < 128; ++i)
                column[i] = i < rows ? i : NAN;
            for (int frame = horizon - 1; frame < horizon + 2; ++frame) {
                const double position = frame * 0.02 / spacing, end = rows - 1;
                const double value = simbias_interpolated(frame * 0.02 / spacing, rows, column);
                if (!(fabs(value - (position < end ? position : end)) < 1e-9))
                    return 1;
            }
        }
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None or machine() not in ("x86_64", "AMD64"), reason="no compiler for x87")
def test_nothing_beyond_a_table_is_read_where_numbers_are_more_precise(tmp_path: Path) -> None:
    """In the registers of x87 a time just before the horizon may round up to it."""
    (tmp_path / "main.c").write_text(f"#include <math.h>\n{templates.INTERPOLATED}{LOOKED_UP}")
    for options in (["-O2"], ["-O1", "-mfpmath=387"], ["-O3", "-mfpmath=387"]):
        command = [str(COMPILER), *options, "-o", tmp_path / "main", tmp_path / "main.c"]
        subprocess.run(command, check=True)
        assert subprocess.run([tmp_path / "main"]).returncode == 0, options


class Chaotic(Integral):
    """A law whose state, where it is pushed hard, multiplies each rounding by ten in every frame."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        policy_state = np.sin(theta * x[..., :1] + x[..., :1] ** 2 * policy_state)
        return policy_state, policy_state


class AgainstFriction(Integral):
    """A law that makes up for dry friction: any rate at all changes it, and its start is at rest."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return -theta * x[..., :1] - 0.3 * np.sign(x[..., 1:]), policy_state


@pytest.mark.slow
def test_what_rounding_changes_is_no_difference() -> None:
    """Code of a law that is a rounding off is taken, and code of another law is not."""
    task, bounds = PointMass(), bounds_of(PointMass())
    for kind, (error, differs) in product((Chaotic, AgainstFriction), ((1e-15, False), (1e-6, True))):
        made = code(kind(task), task, np.array([1.0 + error]), bounds)
        assert bool(difference(kind(task), task, np.ones(1), bounds, *made)) == differs, (kind, error)


def test_a_policy_that_decides_by_values_says_why() -> None:
    request = of_mass(Branching)
    assert "Branching.act (test_controllers.py:" in request.why_no_code
    assert "it branches on a value" in request.why_no_code
    assert request.code("") == {}
    words = Policy.law(Integral(PointMass()), np.ones(1)).words
    assert words == "u = Integral.act(theta, x, t, policy_state)"


def test_limits_are_in_the_request_and_held_by_its_controller(study: Study) -> None:
    class Limited(ExperimentRequest):
        bounds = Bounds(
            (np.array([-5.0]), np.array([5.0])), np.array([2000.0]), np.array([0.2, *[np.inf] * 5]), False
        )

    limited = Limited(study.task, study.policy, THETA, study.task.start_mean)
    module = limited.code("a test")[MODULE]
    content = limited.content()
    assert [state["limit"] for state in content["states"][:2]] == [0.2, None]
    assert (content["inputs"][0]["limit"], content["inputs"][0]["limit_of_change_per_s"]) == (5.0, 2000.0)
    assert np.abs(controller(module)(np.zeros(6))).max() == 0.0
    for x, failure in (([0.21, 0, 0, 0, 0, 0], "state_alpha_w"), ([0.0, 0, 3.0, 0, 0, 0], "input_torque")):
        with pytest.raises(ValueError, match=f"abort: unsafe_{failure}: x"):
            controller(module)(np.array(x))
    control = controller(module)
    assert control(np.array([0.0, 0, 0.1, 0, 0, 0])) == pytest.approx(1.85, abs=0.01)
    with pytest.raises(ValueError, match="abort: unsafe_rate_of_torque"):  # 3.6 N m in a frame of 1 ms
        control(np.array([0.0, 0, -0.1, 0, 0, 0]))


@pytest.mark.slow
def test_failure_criteria_that_abort_are_in_the_code(study: Study) -> None:
    """C agrees with the policy at them: `why_no_code` compiles it."""
    spinning = np.array([0.0, 0, 0, 31.0, 0, 0])
    assert study.task.failure(spinning)
    lenient, strict = (
        ExperimentRequest(
            study.task,
            SafetyLimitedPolicy(study.policy, study.task, Safety(criteria=criteria).bounds(study.task)),
            1e-3 * THETA,
            study.task.start_mean,
        )
        for criteria in (False, True)
    )
    assert strict.why_no_code == ""
    assert np.isfinite(controller(lenient)(spinning))
    with pytest.raises(ValueError, match="abort: failed"):
        controller(strict)(spinning)
    assert "no failure above" in files(strict)["README.txt"]


class Root(Integral):
    """A law that has no number of negative states."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return np.sqrt(x[..., :1]), policy_state


class Overflowing(Integral):
    """A law whose state overflows where its input does not, as that of a filter which diverges."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        return 0.0 * x[..., :1], np.exp(900.0 * x[..., :1])


def test_limits_have_the_names_that_simbias_has_them_by() -> None:
    """Also those of an input or a policy's state that is no number, and with letters of any alphabet."""
    task, bounds = PointMass(), bounds_of(PointMass(), 1.0)
    task.states = (Quantity("θ", "rad"), Quantity("φ", "rad"))
    for policy, x in (
        (Root(task), [-0.5, 0.0]),
        (Root(task), [2.0, 0.0]),
        (Root(task), [0.0, 2.0]),
        (Overflowing(task), [0.9, 0.0]),
    ):
        header, module = code(policy, task, np.zeros(1), bounds)
        limited = SafetyLimitedPolicy(policy, task, bounds).controller(np.zeros(1), 0.02)
        with pytest.raises(UnsafeError) as error, np.errstate(all="ignore"):
            limited(np.array(x))
        with pytest.raises(ValueError, match=f"abort: {error.value}: "):
            controller(module)(x)
        assert f'"{error.value}"' in header


ENDS = 'a "\\\n\r\0*/?{}é²\u2028'  # of what may end a string, a comment or a line


@given(
    st.text(st.sampled_from(ENDS), max_size=60),
    st.sampled_from(["", "*/", "\\", "\n", '"""', "??/", "/*", "\u2028", "\r"]),
)
@settings(max_examples=10, deadline=None)
def test_words_of_a_config_are_never_code(words: str, worst: str) -> None:
    """The Python module is the same but for its first string, the header but for its comments, and names."""
    task, plain = PointMass(), PointMass()
    said = words + worst + words
    task.states = tuple(Quantity(f"{said}{state.name}", said) for state in task.states)
    task.inputs = tuple(Quantity(each.name, said) for each in task.inputs)
    law = formulas_of(Integral(plain), plain, np.array([3.0]))
    assert not isinstance(law, str)
    bounds = bounds_of(plain)
    for line in harmless(said), python_module(task, law, said, bounds), c_header(task, law, said, bounds):
        assert not set("\\\r\u2028?") & set(line.replace("?", "", line.count(" ? ")))
    modules, headers = (
        [re.sub(r'"unsafe_state_[^"]+"', '""', write(each, law, said, bounds)) for each in (task, plain)]
        for write in (python_module, c_header)
    )
    python, other = map(ast.parse, modules)
    assert [ast.dump(node) for node in python.body[1:]] == [ast.dump(node) for node in other.body[1:]]
    header, other_header = (re.sub(r"/\*.*?\*/", "", each, flags=re.DOTALL) for each in headers)
    assert header == other_header
