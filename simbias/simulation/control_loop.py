"""An experiment on a robot, stepped frame by frame: noise, control, failure and the record."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Literal

import numpy as np

from simbias.core import HardwareError, Policy, Task
from simbias.core.records import Array, Disturbance, Rollout

Record = Literal["true_state", "measured"]
BLOW_UP = "physics_engine_blew_up"


class Robot(ABC):
    """A running robot."""

    @abstractmethod
    def state(self) -> Array:
        """The true state (n,)."""

    @abstractmethod
    def step(self, u: Array) -> None:
        """Advance one frame under the input u (m,)."""

    @abstractmethod
    def failure(self) -> str | None:
        """Name of the violated criterion, if any."""

    def reading(self) -> Array:
        """The reading (n,) of the state by noise-free sensors."""
        return self.state()


def experiment(
    task: Task, robot: Robot, policy: Policy, theta: Array, noise: Disturbance, record: Record
) -> Rollout:
    """Run theta (p,) on a robot from its current state until failure or the horizon.

    Failure is judged by the true states. Either these or the measured states are recorded.

    HardwareError if the robot's state or the policy's input is not finite.
    """
    states = [robot.state()]
    if not _is_finite(states[0]):
        raise HardwareError(f"the robot cannot start at {states[0]}")
    measured = [robot.reading() + noise.sensors[0]]
    inputs: list[Array] = []
    failure = robot.failure()
    controller = policy.controller(theta, task.time_step)
    while failure is None and len(inputs) < task.horizon:
        t = len(inputs)
        u = controller(measured[t])
        if not _is_finite(u):
            raise HardwareError(f"in frame {t} the policy asks for an input of {u.tolist()}")
        robot.step(u + noise.inputs[t])
        x = robot.state()
        if not _is_finite(x):
            failure = BLOW_UP  # x is not valid; the record ends with the previous state
            break
        inputs.append(u)
        states.append(x)
        measured.append(robot.reading() + noise.sensors[t + 1])
        failure = robot.failure()
    seen = np.array(measured)
    return Rollout(
        states=seen if record == "measured" else np.array(states),
        inputs=np.array(inputs).reshape(-1, len(task.inputs)),
        failed_at=None if failure is None else len(inputs),
        failure=failure,
        measured=seen,
        sensed=record == "measured",
    )


def _is_finite(values: Array) -> bool:
    """Whether all of a few numbers (n,) are finite; faster than NumPy."""
    return all(map(math.isfinite, values.tolist()))
