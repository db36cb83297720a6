"""What a declared task may say of goals, success, starts and pushes, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from errors import one_line
from interpreted import assert_alike, interpreted
from mechanisms import CARTPOLE, declared

import simbias
from simbias.core import Model
from simbias.core.records import Rollout
from simbias.lab.checks import check_rollout
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator

STILL = {"still": {"value": "abs(angle_error)", "below": 0.1}}
PULSES = {"count": 3, "amplitude": [20.0, 50.0], "seconds": [0.05, 0.1]}


def table(folder: Path, text: str) -> str:
    (folder / "reference.csv").write_text(text)
    return str(folder / "reference.csv")


def test_without_a_goal_all_states_are_to_be_zero() -> None:
    task, x = declared(), np.array([[0.1, 0.2, 0.3, 0.4]])
    assert task.goals == task.states
    np.testing.assert_array_equal(task.error(x, 0.7), x)
    assert task.succeeds(np.zeros((126, 4))) is None


def test_a_goal_moves_and_an_angle_wraps() -> None:
    states = CARTPOLE["states"] | {"angle": {"unit": "rad", "wraps": True}}
    task = declared(states=states, failure=None, goal={"position": "0.3 * sin(2 * t)", "angle": "pi"})
    x, t = np.array([[0.5, -3.0, 0, 0], [0.5, 9.0, 0, 0]]), np.array([0.2, 1.0])
    expected = np.stack([0.5 - 0.3 * np.sin(2 * t), [np.pi - 3.0, 9.0 - 3 * np.pi]], axis=-1)
    np.testing.assert_allclose(task.error(x, t), expected, atol=1e-12)
    np.testing.assert_allclose(task.error(x[0], 0.2), expected[0], atol=1e-12)


def test_a_file_is_linear_between_its_rows_and_then_stays(tmp_path: Path) -> None:
    file = table(tmp_path, "t,position\n0,0.1\n2,0.3\n3,0.2\n5,0.1\n")
    task = declared(reference=file)
    t = np.linspace(0, 7, 50)
    expected = np.interp(t, [0, 2, 3, 5], [0.1, 0.3, 0.2, 0.1])
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


def test_what_cannot_be_meant_is_refused() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"goal": {"height": "0"}}, "goal: no state or output is called height; there is position"),
        ({"goal": {"position": "0.5 + t"}}, "goal.position is 0.95.* where the task fails: leaves"),
        ({"goal": {"position": "sqrt(1 - t)"}}, "goal.position is no number at t = 1"),
        ({"goal": {"position": "angle"}}, "goal.position: 'angle': nothing is called angle; there is t"),
        ({"success": STILL}, "success and hold are to be given together"),
        ({"success": STILL, "hold": 6.0}, "hold is 6 s, and an episode 5 s: none can succeed"),
        ({"starts": [[0.0]]}, "each has to have 4 numbers"),
        ({"pushes": {"torque": PULSES}}, "pushes: no input is called torque; there is force"),
        ({"pushes": {"force": PULSES | {"amplitude": [2, 1]}}}, "not from less to more"),
        ({"reference": "none.csv"}, "reference 'none.csv': .*No such file"),
    ]
    for changes, message in cases:
        with one_line(message):
            declared(**changes)


def test_a_reference_that_cannot_be_meant_is_refused(tmp_path: Path) -> None:
    for text, message in (
        ("t,position\n0,0\n3,0.1\n", "ends at 3 s; an episode takes 5 s"),
        ("t,position\n0,0\n1,0.1\n1.01,0.7\n5,0.8\n", "position jumps after t = 1 s"),
        ("t,position\n0,0\n5,a\n", "could not convert string to float"),
        ("time,position\n0,0\n5,1\n", "expected rows of t and of the goal's quantities"),
        ("t,position\n0,0\n0,1\n5,1\n", "t has to grow from 0"),
    ):
        with one_line(message):
            declared(reference=table(tmp_path, text))
