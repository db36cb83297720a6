"""A bongoboard whose hardware should move as its model, and constant torques to hold them to it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from mechanisms import shipped_task

from simbias.core import Policy
from simbias.core.records import Array, Rollout
from simbias.robots.bongoboard.pymunk import PymunkBongoboard, World
from simbias.robots.bongoboard.task import Bongoboard, Limits, Robot, Start

START = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])
MOVING = np.array([0.1, -0.05, 0.08, 0.3, -0.2, 0.5])
UNLIMITED = {"distance": 1e9, "body_angle": 1e9, "board_angle": 1e9, "speed": 1e9}


class Constant(Policy):
    """The torque theta (1,), whatever the state."""

    n_parameters = 1
    bounds = (np.array([-np.inf]), np.array([np.inf]))

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        return theta, memory


def build_task(
    limits: dict[str, float] | None = None, robot: dict[str, float] | None = None, **changes: Any
) -> Bongoboard:
    """The task of conf/task/bongoboard.yaml with some changes."""
    config = shipped_task("bongoboard")
    return Bongoboard(
        Robot(**config["robot"] | (robot or {})),
        Limits(**config["limits"] | (limits or {})),
        Start(**config["start"]),
        **changes,
    )


def build_twin(time_step: float = 0.001, **changes: Any) -> Bongoboard:
    """A task on which fixed feet should move as the Lagrangian model of the default task.

    That model has both legs in their midst. Half the ankle spacing s away from it, they turn with the pelvis
    and add a moment of inertia of 2 m_l (s/2)^2 to it, which the twin takes off the pelvis.
    """
    robot = build_task().robot
    legs = 2 * robot.leg_mass * (robot.ankle_spacing / 2) ** 2
    inertia = {"pelvis_inertia": robot.pelvis_inertia - legs}
    return build_task(UNLIMITED, inertia, time_step=time_step, **changes)


def experiment(hardware: PymunkBongoboard, torque: float, start: Array = START, seed: int = 0) -> Rollout:
    """An experiment under constant torque, whose record is consistent."""
    rollout = hardware.run(Constant(), np.array([torque]), start, np.random.default_rng(seed))
    assert len(rollout.states) == len(rollout.measured) == len(rollout.inputs) + 1
    for values in (rollout.states, rollout.inputs, rollout.measured):
        assert np.isfinite(values).all()
    assert (rollout.failed_at is None) == (rollout.failure is None)
    assert rollout.failed_at in (None, rollout.frames)
    return rollout


def energy(world: World, gravity: float) -> float:
    """Kinetic and potential energy in J of all bodies (pymunk's kinetic_energy is twice that)."""
    return sum(b.kinetic_energy / 2 + b.mass * gravity * b.position.y for b in world.bodies.values())


def runge_kutta(
    accelerations: Callable[[float, Array], Array], x: Array, duration: float, steps: int
) -> Array:
    """States (steps + 1, 6) of the fourth-order method for accelerations (3,) at a time and a state."""

    def slope(t: float, x: Array) -> Array:
        return np.concatenate((x[3:], accelerations(t, x)))

    h, states = duration / steps, [x]
    for t in h * np.arange(steps):
        k1 = slope(t, x)
        k2 = slope(t + h / 2, x + h / 2 * k1)
        k3 = slope(t + h / 2, x + h / 2 * k2)
        k4 = slope(t + h * (1 - 1e-4), x + h * k3)  # just before what may happen there
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    return np.array(states)
