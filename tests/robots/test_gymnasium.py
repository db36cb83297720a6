"""Gymnasium's environments as hardware: against MuJoCo itself, from starts that they can be set to."""

from typing import Any

import numpy as np
import pytest
from errors import one_line
from gymnasium.spaces import Box, MultiBinary, MultiDiscrete, Space
from mechanisms import DOUBLE, cart_pole

import simbias
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.gymnasium import Gymnasium, Start, _Action
from simbias.robots.mujoco.hardware import Mujoco

PENDULUM: dict[str, Any] = {
    "time_step": 0.05,
    "states": {"angle": {"unit": "rad", "mean": 0.2}, "rate": {"unit": "rad/s"}},
    "inputs": {"torque": {"unit": "N m", "limit": 2.0}},
    "failure": {"falls": {"value": "abs(angle)", "above": 1.0}},
}
OF_PENDULUM = {"angle": "atan2(observation[1], observation[0])", "rate": "observation[2]"}
POLE: dict[str, Any] = {"time_step": 0.02, "inputs": {"force": {"unit": "10 N", "limit": 1.0}}}


def test_it_is_the_engine_below_it() -> None:
    """The same robot and gap in MuJoCo alone, without Gymnasium's loop and observation."""
    double = simbias.load(["preset=double_cartpole", "tracking=none"])
    task, rng = double.task, np.random.default_rng(3)
    config = double.config["hardware"]
    alone = Mujoco(task, DOUBLE, values=config["values"], factors=config["factors"])
    theta, start = np.array([-2.0, -6.0, -7.0, -3.0, -4.0, -4.0]), task.draw_start(rng)
    one, other = (hardware.run(double.policy, theta, start, rng) for hardware in (double.hardware, alone))
    assert one.frames == other.frames > 5
    np.testing.assert_array_equal(one.states[0], start)
    np.testing.assert_allclose(one.states, other.states, atol=1e-9)


def test_classic_control_is_set_by_its_state() -> None:
    """Gymnasium's pendulum: an unstable one, its angle from the top; of the equation in its documentation."""
    task = cart_pole(**PENDULUM)
    hardware = Gymnasium(task, "Pendulum-v1", states=OF_PENDULUM, start=Start(state=["angle", "rate"]))
    made = hardware.run(
        OutputFeedback(task), np.array([-1.0, -0.5]), np.array([0.2, 0.1]), np.random.default_rng(0)
    )
    assert hardware.sets_start
    (angle, rate), u = made.states[:-1].T, made.inputs[:, 0]
    faster = rate + (3 * 10.0 / 2 * np.sin(angle) + 3.0 * u) * 0.05
    np.testing.assert_allclose(made.states[1:, 1], faster, atol=1e-5)
    np.testing.assert_allclose(made.states[1:, 0], angle + 0.05 * faster, atol=1e-5)


def test_where_it_begins_by_itself_is_recorded() -> None:
    task = cart_pole(**PENDULUM)
    hardware = Gymnasium(task, "Pendulum-v1", states=OF_PENDULUM)
    policy, starts = OutputFeedback(task), []
    for seed in (0, 0, 1):
        made = hardware.run(policy, np.zeros(2), np.zeros(2), np.random.default_rng(seed))
        starts.append(made.states[0].tolist())
    assert not hardware.sets_start
    assert starts[0] == starts[1] != starts[2]


def test_what_the_environment_ends_has_failed_and_choices_are_rounded() -> None:
    """CartPole-v1 pushes with all its force to either side, and ends at 0.21 rad, before the task does."""
    order = {"position": 0, "angle": 2, "d_position": 1, "d_angle": 3}
    task = cart_pole(**POLE)
    hardware = Gymnasium(
        task,
        "CartPole-v1",
        states={name: f"observation[{index}]" for name, index in order.items()},
        action=["(1 + force) / 2"],
    )
    made = hardware.run(OutputFeedback(task), np.array([9.0, 0, 0, 0]), np.zeros(4), np.random.default_rng(0))
    assert made.failure == "terminated"
    assert made.failed_at == made.frames
    assert 0.2 < abs(made.states[-1, 1]) < 0.5


def test_what_does_not_go_with_the_task_is_one_line() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"environment": "NoSuch-v0"}, "'NoSuch-v0': "),
        ({"environment": "os:NoSuch-v0"}, "names a module"),
        ({"environment": "CartPole-v1"}, "a step of CartPole-v1 takes 0.02 s; task.time_step is 0.05 s"),
        ({"states": None}, "an observation of Pendulum-v1 has 3 numbers; the task has 2 states"),
        ({"states": {"angle": "observation[0]"}}, "states: expected angle, rate, got angle"),
        ({"states": {"angle": "observation[3]", "rate": "1"}}, r"nothing is called observation\[3\]"),
        ({"action": ["2 * torque"]}, r"at the input \[-2.0\] the action is \[-4.0\]; Pendulum-v1 takes"),
        ({"action": ["torque", "torque"]}, "an action of Pendulum-v1 has 1 numbers; the config gives 2"),
        ({"start": Start(qpos=["angle"], qvel=["rate"])}, "start: Pendulum-v1 cannot be set by qpos, qvel"),
        ({"start": Start()}, "start: no expressions are given"),
        ({"start": Start(state=["angle"])}, "start: the state of Pendulum-v1 has 2 numbers, got 1"),
        ({"environment": "Mine-v0"}, "doesn't exist. If it is your own, call gymnasium.register"),
        ({"factors": {"*.mass": 2.0}}, "Pendulum-v1 is not a MuJoCo environment"),
        ({"options": {"colour": 1}}, "'Pendulum-v1': "),
    ]
    for changes, message in cases:
        arguments: dict[str, Any] = {"environment": "Pendulum-v1", "states": OF_PENDULUM, **changes}
        with one_line(message, ValueError):
            Gymnasium(cart_pole(**PENDULUM), **arguments)


@pytest.mark.parametrize("space", [MultiDiscrete([2, 2]), MultiBinary(1), Box(-1, 1, (2, 2))], ids=str)
def test_actions_that_are_neither_a_vector_nor_one_of_several_are_one_line(space: Space) -> None:
    with one_line("an action of Any-v0 is neither a vector nor a discrete choice, but ", ValueError):
        _Action(space, cart_pole(**PENDULUM), None, "Any-v0")
