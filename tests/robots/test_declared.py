"""A declared task: its expressions, goals, success, starts and pushes, and what it may not say."""

import warnings
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors import one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from interpreted import assert_alike, interpreted
from mechanisms import CARTPOLE, DOUBLE, declared, drawn_from, shipped_task
from point_mass import PointMass

import simbias
from simbias.config.allowed import NOTHING
from simbias.config.build import build_task
from simbias.config.components import construct
from simbias.config.identity import identity_fields
from simbias.core import HardwareError, Model, Quantity, StudyWarning, Task, wrapped
from simbias.core.quantities import unwound
from simbias.core.records import Array, Rollout
from simbias.core.task_checks import check_quantities, check_starts
from simbias.lab.checks import check_rollout
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler import Expressions
from simbias.simulation.compiler.choices import greater, lesser
from simbias.simulation.compiler.symbolic_arrays import row
from simbias.simulation.compiler.symbols import Trace
from simbias.simulation.compiler.written import written
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator


@given(st.floats(-4, 4), st.floats(-4, 4))
@settings(deadline=None, max_examples=25)
def test_expressions_mean_what_they_say(a: float, b: float) -> None:
    """Numbers, arrays and the kernel agree with NumPy."""
    texts = {
        "sum": "1 + 2 * a - b / 3",
        "power": "-a**2 + b**3 - (a - b)**4",
        "functions": "sin(a) * cos(b) + abs(a) + sqrt(b**2) + atan2(a, 2 + b) + exp(-a / 2)",
        "extremes": "min(a, b, 1.5) - max(-a, b)",
        "names": "twice + c * pi",
    }
    expressions = Expressions(texts, ("a", "b"), {"c": 0.5}, {"twice": "2 * a"})
    expected = [
        1 + 2 * a - b / 3,
        -(a**2) + b**3 - (a - b) ** 4,
        np.sin(a) * np.cos(b) + abs(a) + abs(b) + np.arctan2(a, 2 + b) + np.exp(-a / 2),
        min(a, b, 1.5) - max(-a, b),
        2 * a + 0.5 * np.pi,
    ]
    np.testing.assert_allclose(expressions(np.array([a, b])), expected, atol=1e-9)
    np.testing.assert_allclose(
        expressions(np.full((2, 3, 2), [a, b])), np.full((2, 3, 5), expected), atol=1e-9
    )


def test_what_is_not_a_number_stays_none() -> None:
    """So that a rollout whose state is not a number fails, in NumPy and compiled."""
    for extreme, position in product(("min", "max"), range(3)):
        expression = Expressions({"extreme": f"{extreme}(a, b, c)"}, ("a", "b", "c"))
        x = np.ones(3)
        x[position] = np.nan
        assert np.isnan(expression(x))
        substitute = {"min": lesser, "max": greater}[extreme].substitute
        assert np.isnan(substitute(substitute(x[0], x[1]), x[2]))


def test_failure_is_the_first_criterion_that_is_beyond_its_limit() -> None:
    criteria = {
        "low": {"value": "position  # to the left", "below": -1.0},
        "far": {"value": "µ * position**2", "above": 4.0},
        "falls": {"value": "max(angle, -angle)", "above": 0.5},
    }
    constants = CARTPOLE["constants"] | {"µ": 1.0}  # of a keyboard; Python reads it as μ
    task = declared(failure=criteria, constants=constants)
    x = np.array([[0.0, 0.4], [-1.5, 1.0], [3.0, 0.0], [0.0, -0.6], [-1.0, 0.5]])
    assert task.violated(np.hstack([x, np.zeros((5, 2))])).tolist() == [-1, 0, 1, 2, -1]
    assert task.failure(np.array([3.0, 1.0, 0.0, 0.0])) == "far"


def test_only_an_upper_limit_of_a_state_bounds_it() -> None:
    """A goal of a state that must not come near zero is beyond that."""
    far, near = {"value": "abs(position)", "above": 2.0}, {"value": "abs(position)", "below": 0.2}
    goal = {"position": "0.5 + 0.1 * sin(t)"}
    task = declared(failure={"far": far, "near": near}, goal=goal, starts=[[0.5, 0, 0, 0]])
    assert [criterion.bounds for criterion in task.criteria] == [{"position": 2.0}, {}]
    assert task.violated(np.array([[0.3, 0, 0, 0], [0.1, 0, 0, 0], [2.1, 0, 0, 0]])).tolist() == [-1, 1, 0]


def test_other_numbers_need_no_other_code() -> None:
    texts = []
    for number in (2.5, 3.5):
        trace = Trace()
        result = [list(Expressions({"f": f"{number} * a + sin(a)"}, ("a",))(row(trace, "x", 1))[0])]
        texts.append(written(trace, result, "x, p").function)
    assert texts[0] is texts[1]


def test_nothing_else_is_an_expression() -> None:
    for text in (
        *("__import__('os').system('true')", "a.real", "(lambda: 1)()", "[a for a in b]", "a if b else 1"),
        *("a < b", "a ** b", "a ** 1000000", "a and b", "'text'", "True", "1e400", "abs(a, b)", "abs(x=a)"),
        *("min(a)", "min(*a)", "eval(a)", "f'{a}'", "a[0]", "(a := 1)", "await a", "c", "1 +"),
        *("(" * 500 + "a" + ")" * 500, "-" * 900 + "a"),
    ):
        with one_line("^f: ", ValueError):
            Expressions({"f": text}, ("a", "b"))


def test_the_order_of_states_counts_in_the_identity() -> None:
    """A policy and a cost know them by their places."""
    turned = {**CARTPOLE, "states": dict(reversed(CARTPOLE["states"].items()))}
    one, other = (str(identity_fields({"task": config}, ())) for config in (CARTPOLE, turned))
    assert one != other


def test_a_file_draws_its_geoms() -> None:
    """Where the equations say that its poles are, which the declared drawing says too."""
    declared_too = construct(shipped_task("double_cartpole"), Task, "task")
    of_file = drawn_from(file=DOUBLE)
    x = np.array([0.3, 0.1, -0.2, 0.0, 0.0, 0.0])
    by_file, by_declaration = of_file.points(x), declared_too.points(x)
    for geom, part in (("cpole", "lower_pole"), ("cpole2", "upper_pole")):
        lower_end_first = by_file[geom][np.argsort(by_file[geom][:, 1])]
        np.testing.assert_allclose(lower_end_first, by_declaration[part], atol=1e-6)
    assert of_file.drawing["cpole"].thickness == pytest.approx(0.09)
    assert "floor" not in by_file
    target = {"points": [["0.2 + reach", "0.5"]], "grey": 0.8}  # no part of the robot
    goal = {"targets": {"reach": {"unit": "m", "mean": 0.1}}, "goal": {"position": "reach"}}
    drawing = {**shipped_task("double_cartpole")["drawing"], "target": target}
    task = {**shipped_task("double_cartpole"), **goal, "drawing": drawing, "figure": {"file": DOUBLE}}
    beside = construct(task, Task, "task")
    placed = beside.points(np.append(x, 0.4))
    assert list(placed) == ["rail", "target", *(geom for geom in by_file if geom != "rail")]
    np.testing.assert_allclose(placed["target"], [[0.6, 0.5]])


NEVER = {"near": {"value": "abs(position_error)", "below": -0.1, "unit": "m"}}
CONTRARY = {"more": {"value": "position", "above": 1}, "less": {"value": "position", "below": 0.5}}
STILL = {"still": {"value": "abs(angle_error)", "below": 0.1}}
PULSES = {"count": 3, "amplitude": [20.0, 50.0], "seconds": [0.05, 0.1]}


def table(folder: Path, text: str) -> str:
    (folder / "reference.csv").write_text(text, encoding="utf-8")
    return str(folder / "reference.csv")


def test_without_a_goal_all_states_are_to_be_zero() -> None:
    task, x = declared(), np.array([[0.1, 0.2, 0.3, 0.4]])
    assert task.goals == task.states
    np.testing.assert_array_equal(task.error(x, 0.7), x)
    assert task.succeeds(np.zeros((126, 4))) is None


def test_a_goal_that_turns_on_is_not_asked_whether_it_is_in_degrees(recwarn: pytest.WarningsRecorder) -> None:
    states = CARTPOLE["states"] | {"angle": {"unit": "rad", "wraps": True}}
    declared(states=states, failure=None, goal={"angle": "-20.0 * t"})
    assert not recwarn.list


@pytest.mark.parametrize(("unit", "half"), [("rad", np.pi), ("deg", 180.0), ("rev", 0.5)])
def test_a_goal_moves_and_an_angle_wraps_by_a_turn_in_its_unit(unit: str, half: float) -> None:
    states = CARTPOLE["states"] | {"angle": {"unit": unit, "wraps": True}}
    asked = pytest.warns(StudyWarning, match=r"angle is 180 rad, more than 2 turns: is it in degrees\?")
    with asked if unit == "rad" else warnings.catch_warnings(action="error"):
        declared(states=states, failure=None, goal={"angle": "180.0"})
    task = declared(states=states, failure=None, goal={"position": "0.3 * sin(2 * t)", "angle": str(half)})
    x, t = np.array([[0.5, -0.9 * half, 0, 0], [0.5, 2.8 * half, 0, 0]]), np.array([0.2, 1.0])
    expected = np.stack([0.5 - 0.3 * np.sin(2 * t), [0.1 * half, -0.2 * half]], axis=-1)
    np.testing.assert_allclose(task.error(x, t), expected, atol=1e-12)
    np.testing.assert_allclose(task.error(x[0], 0.2), expected[0], atol=1e-12)
    turning = np.column_stack([np.zeros(60), np.linspace(0, 5 * half, 60)])
    angles = wrapped(turning, task.states[:2])
    np.testing.assert_allclose(unwound(angles, task.states[:2]), turning, atol=1e-9)


def test_each_column_is_of_one_quantity_and_what_wraps_has_a_turn() -> None:
    class Heading(PointMass):
        goals = (Quantity("heading", "degrees", wraps=True),)

    states, time = CARTPOLE["states"] | {"force": {"unit": "N"}}, {"time": {"unit": "m"}}
    with one_line("^heading wraps: expected an angle in rad, .*got the unit degrees", ValueError):
        check_quantities(Heading())
    with one_line("^task: force: two of time, states, targets, inputs and failure have this name"):
        declared(states=states)
    with one_line("^task: time: two of time"):
        declared(targets=time, goal={"position": "0.1 * time"})
    with one_line("^task: angle wraps: expected an angle in rad, .*got the unit m"):
        simbias.load(["preset=cartpole_swingup", "tracking=none", "task.states.angle.unit=m"])


def test_a_frame_may_take_minutes() -> None:
    assert declared(time_step=60.0).frames(3600.0) == 60


def test_a_file_is_linear_between_its_rows_blank_lines_or_not_and_then_stays(tmp_path: Path) -> None:
    text, t = "\nt,position\n0,0.1\n2,0.3\n3,0.2\n5,0.1\n\n", np.linspace(0, 7, 50)
    expected = np.interp(t, [0, 2, 3, 5], [0.1, 0.3, 0.2, 0.1])
    as_recordings = "\ufeff# made by hand\n" + text.strip().replace(",", "; ").replace(".", ",")
    for rows in (text, as_recordings):
        task = declared(reference=table(tmp_path, rows))
        np.testing.assert_allclose(task.reference(t)[:, 0], expected, atol=1e-12)


def test_success_is_the_tasks_and_holds_at_the_end() -> None:
    study = simbias.load(["preset=cartpole"])
    task = declared(success=STILL, hold=1.0, goal={"angle": "0.03 * t"})
    t = task.time_step * np.arange(task.horizon + 1)
    states = np.zeros((len(t), 4))
    states[:, 1] = np.where(t < 3.9, 1.0, 0.03 * t + 0.09)
    late = states.copy()
    late[-20] += 0.02
    own = replace(study, task=task)
    for episode, succeeds in ((states, True), (late, False)):
        assert task.succeeds(episode) is succeeds
        assert own.passes(Rollout(episode, np.zeros((len(t) - 1, 1)), cost=1e9)) is succeeds
    assert not own.passes(Rollout(states, np.zeros((len(t) - 1, 1)), len(t) - 1, "falls"))
    assert task.uptime(states) == pytest.approx(np.mean(t > 3.89))
    assert task.uptime(states[t < 4.5]) == pytest.approx(np.mean((t > 3.89) & (t < 4.5)))  # it failed then
    assert np.isnan(declared().uptime(states))


def test_starts_are_of_any_distribution() -> None:
    means: Any = [{"uniform": [-0.5, 0.1]}, {"values": [0.0, 3.0]}, {"mean": 0.1, "deviation": 0.2}, {}]
    states = {name: {"unit": "m"} | mean for name, mean in zip("abcd", means, strict=True)}
    task = declared(states=states, failure=None, drawing=None)
    x = np.array([task.draw_start(rng) for rng in np.random.default_rng(0).spawn(1000)])
    assert -0.5 < x[:, 0].min() < -0.48
    assert 0.08 < x[:, 0].max() < 0.1
    assert set(x[:, 1]) == {0.0, 3.0}
    np.testing.assert_allclose(x.mean(axis=0), task.start_mean, atol=0.07)
    np.testing.assert_allclose(x.std(axis=0), task.start_deviation, rtol=0.08)
    plain = {name: {"unit": "m"} for name in "abcd"}
    two = [[0.0, 0.1, 0, 0], [0.5, -0.1, 0, 0]]
    listed = declared(starts=two, states=plain, failure=None, drawing=None)
    found = {tuple(listed.draw_start(rng)) for rng in np.random.default_rng(0).spawn(20)}
    assert found == {(0.0, 0.1, 0.0, 0.0), (0.5, -0.1, 0.0, 0.0)}


def test_pushes_are_added_to_what_acts_and_change_no_noise() -> None:
    variances = {"force_variance": 0.1, "velocity_variance": 0.01}
    calm, pushed = (Noise(task, variances) for task in (declared(), declared(pushes={"force": PULSES})))
    assert not Noise(declared(pushes={"force": PULSES}), {}).is_silent
    one, other = (noise.draw(np.random.default_rng(3)) for noise in (calm, pushed))
    np.testing.assert_array_equal(one.sensors, other.sensors)
    pulses = np.abs(other.inputs - one.inputs)[:, 0]
    assert 15.0 < pulses.max() < 150.0
    assert np.mean(pulses > 1.0) < 0.6


def test_without_failure_a_loop_runs_to_its_end_in_lanes_and_plain() -> None:
    """Unless its state is no number."""
    study = simbias.load(["preset=cartpole"])
    task = declared(failure=None, horizon=50, pushes={"force": PULSES})
    model = Model(task, study.policy, study.nominal, study.bias.fit(study.no_data))
    noise = Noise(task, {}).draw(np.random.default_rng(0))
    compiled, plain = CompiledSimulator.of(model, noise), PlainSimulator([model], [noise])
    assert compiled is not None
    starts = np.array([[0.0, 0.3, 0.0, 0.0], [0.0, 0.1, 0.0, 1e200]])
    thetas = np.full((2, 4), 0.1)
    with interpreted():
        made = compiled.rollouts(thetas, starts)
    assert_alike(made, plain.rollouts(thetas, starts), 1e-6, 0.0)
    assert made[0].frames == task.horizon
    assert made[1].failure == "not_a_number"


def test_what_is_learned_from_does_not_jump_by_a_turn() -> None:
    task = declared(states=CARTPOLE["states"] | {"angle": {"unit": "rad", "wraps": True}}, failure=None)
    angles = np.linspace(3.0, 10.0, task.horizon + 1)
    states = np.zeros((task.horizon + 1, 4))
    states[:, 1] = (angles + np.pi) % (2 * np.pi) - np.pi
    checked = check_rollout(Rollout(states, np.zeros((task.horizon, 1))), "robot", task)
    np.testing.assert_allclose(checked.states[:, 1], angles)


def test_a_condition_that_counts_turns_is_said() -> None:
    """Unless the angle fails before it has turned, or the condition bounds it beyond half a turn."""
    states = CARTPOLE["states"] | {"angle": {"unit": "rad", "wraps": True}}
    turned = {"falls": {"value": "lean", "above": 90.0}}
    winds = {"winds": {"value": "angle - pi", "above": 20.0}, "back": {"value": "angle", "below": -20.0}}
    leans = {"left": {"value": "angle", "above": 1.0}, "right": {"value": "angle", "below": -1.0}}
    for failure, value, said in (
        (None, "abs(angle)", "success.up"),
        (None, "lean", "success.up"),
        (turned, "angle_error", "failure.falls"),
        ({"winds": {"value": "abs(angle)", "above": 9.0}}, "angle_error + abs(sin(angle))", None),
        ({"falls": {"value": "abs(angle)", "above": 1.0}}, "abs(angle)", None),
        (winds, "angle_error", None),
        (leans, "abs(angle)", None),
        ({"falls": {"value": "cos(angle)", "below": 0.0}}, "lean", None),
        ({"left": leans["left"]}, "abs(angle)", "success.up"),
    ):
        options = {"states": states, "where": {"lean": "angle**2"}, "failure": failure, "hold": 1.0}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            declared(**options, success={"up": {"value": value, "below": 0.2}})
        lines = [str(each.message) for each in caught]
        assert [line.partition(" counts the turns of angle, which wraps")[0] for line in lines] == [
            said
        ] * bool(said)


def test_the_tasks_output_is_to_blame_for_an_input_that_is_no_number() -> None:
    task = declared(outputs={"root": {"value": "sqrt(angle)"}}, failure=None)
    states, inputs = np.zeros((task.horizon + 1, 4)), np.zeros((task.horizon, 1))
    inputs[3:] = np.nan
    with one_line(r"robot: inputs: expected finite numbers, got \[nan\] in frame 3$", HardwareError):
        check_rollout(Rollout(states, inputs), "robot", task)
    states[3, 1] = -0.1
    with one_line(r"^task.outputs.root is not finite in frame 3, at .* angle -0.1 rad,", HardwareError):
        check_rollout(Rollout(states, inputs), "robot", task)


def test_what_cannot_be_meant_is_refused() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"inputs": {}}, "^task: inputs is empty"),
        (
            {"failure": {"falls": {"value": "angel", "below": 1}}},
            "^task: failure.falls: 'angel': nothing is called an",
        ),
        (
            {"failure": {"falls": {"value": "abs( angle )", "above": 30, "unit": "deg"}}},
            "^task: failure.falls.unit is deg, but angle is in rad, and bounds are not converted: give this",
        ),
        ({"failure": {"falls": {"value": "angle"}}}, "^task: failure.falls: needs one of above and below"),
        ({"states": {"a b": {"unit": "m"}}}, "^task.states: 'a b' is not a name"),
        ({"constants": {"angle": 1.0}}, "^task: angle: two things have this name"),
        ({"states": {"x": {"unit": "m", "meen": 1}}}, "^task.states.x.meen: no such key"),
        ({"drawing": {"rail": {"points": [["0", "nosuch"]]}}}, "^task: drawing.rail.0.y: 'nosuch'"),
        ({"drawing": {"rail": {"points": [[0, 0, 0]]}}}, "^task.drawing.rail.points.0: "),
        ({"goal": {"height": "0"}}, "goal: no state or output is called height; available: position"),
        (
            {"outputs": {"position": {"value": "2 * position"}}, "goal": {"position": "0.1"}},
            "goal.position: a state and an output with other values have this name",
        ),
        ({"goal": {"position": "0.5 + t"}}, "goal.position is 0.95.* where the task fails: leaves"),
        (
            {"goal": {"position": "-t"}, "failure": {"ends": {"value": "position", "below": -0.5}}},
            "goal.position is -0.501 at t = 0.501 s, where the task fails: ends",
        ),
        (
            {
                "goal": {"position": "0.5", "angle": "-91.4"},
                "failure": {"far": {"value": "max(abs(position), abs(angle))", "above": 2.6}},
            },
            "goal.position is 0.5, goal.angle is -91.4 at t = 0 s, where the task fails: far",
        ),
        ({"goal": {"position": "sqrt(1 - t)"}}, "goal.position is not a finite number at t = 1"),
        ({"goal": {"position": "angle"}}, "goal.position: 'angle': nothing is called angle; available: t"),
        (
            {"goal": {"position": "max(min(1e6 * (t - 2), 0.8), 0)"}},
            r"goal.position jumps after t = 1.96 s: ",
        ),
        ({"success": STILL}, "give success and hold together"),
        ({"success": STILL, "hold": 6.0}, "hold is 6 s, but an episode 5 s: none can succeed"),
        ({"success": NEVER, "hold": 1.0}, "success.near cannot hold: .* is 0 m, not below -0.1 at the goal"),
        (
            {"success": {"late": {"value": "t", "above": 4.5}}, "hold": 1.0},
            "success.late cannot hold: t is 4, not above 4.5 at the goal",
        ),
        (
            {"success": {"far": {"value": "abs( position )", "above": 2}}, "hold": 1.0},
            "success cannot hold: no value of position meets success.far without failure.leaves",
        ),
        (
            {"success": {"far": {"value": "-position", "above": 1}, **CONTRARY}, "hold": 1.0},
            "no value of position meets success.more and success.less without failure.leaves",
        ),
        (
            {"success": {"none": {"value": "abs(d_angle)", "below": 0}}, "hold": 1.0},
            "no value of d_angle meets success.none",
        ),
        (
            {"success": {"root": {"value": "sqrt(-1 - d_angle**2)", "above": -1}}, "hold": 1.0},
            "success.root is not a number in any of 100 states",
        ),
        (
            {"states": CARTPOLE["states"] | {"angle": {"unit": "rad", "uniform": [2, 3]}}},
            "^task: the task fails at all 100 drawn starts: falls",
        ),
        (
            {"outputs": {"ratio": {"value": "angle / 0"}}},
            "^task: output ratio is not finite at all 100 drawn starts that do not fail",
        ),
        (
            {"success": STILL, "hold": 5.0, "starts": [[0.0, 0.2, 0, 0]]},
            "starts.0: hold is a whole episode, but in its last 5 s still is 0.2, not below 0.1 at its start",
        ),
        ({"starts": [[0.0]]}, "each must have 4 numbers"),
        (
            {"starts": [[0.0] * 4], "states": {"position": {"unit": "m", "uniform": [0, 1]}}},
            "states.position: starts replace its uniform or values",
        ),
        ({"starts": [[0.0] * 4, [3.0, 0, 0, 0]]}, "starts.1: the task fails at its start: leaves"),
        ({"targets": {"aim": {"unit": "m", "uniform": [1, 0]}}}, "targets.aim: uniform is"),
        (
            {"failure": {False: {"value": "angle", "above": 1}}},
            "^task.failure: False is not a name; put it in quotes",
        ),
        ({"pushes": {"torque": PULSES}}, "pushes: no input is called torque; available: force"),
        ({"pushes": {"force": PULSES | {"amplitude": [-1, 1]}}}, r"expected 0 <= least <= most, got \[-1, 1"),
        (
            {"pushes": {"force": PULSES | {"seconds": [0.001, 0.1]}}},
            r"pushes.force.seconds: expected at least half a frame \(0.02 s\), got 0.001",
        ),
        (
            {"reference": "none.csv"},
            "reference none.csv: .*No such file.* neither in .* --config-dir",
        ),
    ]
    for changes, message in cases:
        with one_line(message):
            build_task({**CARTPOLE, **changes}, NOTHING)
    half = {"angle": {"unit": "rad", "uniform": [0, 2]}}
    with pytest.warns(StudyWarning, match=r"the task fails at \d\d of 100 drawn starts: falls"):
        build_task({**CARTPOLE, "states": CARTPOLE["states"] | half}, NOTHING)
    task = build_task(CARTPOLE, NOTHING)
    task.outputs = ()  # as of an own class
    with pytest.raises(ValueError, match=r"^output of 100 states: expected shape \(100, 0\), got"):
        check_starts(task)


def test_a_reference_that_cannot_be_meant_is_refused(tmp_path: Path) -> None:
    for text, message in (
        ("t,position\n0,0\n3,0.1\n", "ends at 3 s, an episode at 5 s"),
        (
            "t,position\n0,0\n1,0.1\n1.01,0.7\n5,0.8\n",
            "goal.position jumps after t = 0.96 s: by 0.605 m in 2 frames",
        ),
        ("t,position\n0,0\n1,0\n1.04,0.3\n1.08,0\n5,0\n", "position jumps after t = 1 s: by 0.3 m in 2"),
        ("t,position\n0,0\n1,0\n1.001,0.3\n2,0.3\n2.001,0.6\n5,0.6\n", "position jumps after t = 0.96 s"),
        ("t,position\n0,0\n\n5,\n", "row 4, column position: expected a finite number, got ''"),
        ("t,position\n0,0\n5,0,1\n", "row 3: expected 2 cells as in row 1, got 3"),
        ("time,position\n0,0\n5,1\n", "got the columns 'time,position'"),
        ("t,position\n0,0\n5,nan\n", "row 3, column position: expected a finite number"),
        ("t,position,position\n0,0,0\n5,1,1\n", "got the columns 't,position,position'"),
        ("t,position\n0,0\n0,1\n5,1\n", "t must increase from 0"),
    ):
        with one_line(message):
            declared(reference=table(tmp_path, text))
    declared(reference=table(tmp_path, "t,position\n0,0\n0.5,0.8\n100,0.8\n"))
    for smooth in (
        "0.5 * sin(20 * t)",
        "0.5 * exp(-t) * sin(20 * t)",
        "exp(sin(pi * t)) - exp(sin(pi * (t + 2)))",
    ):
        declared(goal={"position": smooth})
    with pytest.warns(StudyWarning, match=r"lasts 5000 s, but an episode takes 5 s: is its t in ms\?"):
        declared(reference=table(tmp_path, "t,position\n0,0\n5000,0.1\n"))
    swingup, file = shipped_task("pendulum_swingup") | {"time_step": 0.01}, tmp_path / "reference.csv"
    swingup["states"] = swingup["states"] | {"angle": swingup["states"]["angle"] | {"unit": "deg"}}
    swingup["success"]["upright"] = swingup["success"]["upright"] | {"unit": "deg"}

    def of_angles(angles: Array) -> None:
        rows = (f"{0.1 * row:.1f},{angle}" for row, angle in enumerate(angles))
        file.write_text("\n".join(["t,angle", *rows]))
        construct({**swingup, "reference": str(file)}, Task, "task")

    with one_line("row of t = 0.2 s, column angle: -180 is more than half a turn from 171; write 180, or"):
        of_angles(np.append([162, 171, -180, -171], np.full(60, -171)))
    with pytest.warns(StudyWarning, match=r"angle changes by 160 deg within 2 rows of .*, after t = 2.9 s: "):
        of_angles(np.repeat([180, 20], [31, 30]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of_angles(np.cumsum(np.full(64, 170.0)))
        of_angles(90 * np.sin(0.5 * np.arange(64)))
        rows = "".join(f"{row},{row // 4 % 2}\n" for row in range(12))  # of which each takes a second
        declared(reference=table(tmp_path, f"t,position\n{rows}"), failure=None)
