"""An experiment on a robot that is stepped frame by frame: noise, control, failure and the record."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from simbias.interfaces import HardwareError, Policy, Task
from simbias.records import Array, Disturbance, Rollout

Record = Literal["true_state", "measured"]
BLOW_UP = "physics_engine_blew_up"


class Robot(Protocol):
    """A robot under way."""

    def state(self) -> Array:
        """The true state (n,)."""

    def step(self, u: Array) -> str | None:
        """One frame under the input u (m,); the name of a failure that only the robot knows of, if any."""


def experiment(
    task: Task, robot: Robot, policy: Policy, theta: Array, noise: Disturbance, record: Record
) -> Rollout:
    """Run theta (p,) on a robot from where it stands, up to failure or horizon.

    Failure is judged by the true states. What is recorded are these, or the measured ones.

    Raises
    ------
    HardwareError
        If the policy asks for what is no number.
    """
    states = [robot.state()]
    measured = [states[0] + noise.sensors[0]]
    inputs: list[Array] = []
    failure = task.failure(states[0])
    controller = policy.controller(theta, task.time_step)
    while failure is None and len(inputs) < task.horizon:
        t = len(inputs)
        u = controller(measured[t])
        if not np.isfinite(u).all():
            raise HardwareError(f"in frame {t} the policy asks for an input of {u.tolist()}")
        own = robot.step(u + noise.inputs[t])
        x = robot.state()
        if not np.isfinite(x).all():
            failure = BLOW_UP  # x is no state; the record ends with the one before
            break
        inputs.append(u)
        states.append(x)
        measured.append(x + noise.sensors[t + 1])
        failure = task.failure(x) or own
    seen = np.array(measured)
    return Rollout(
        states=seen if record == "measured" else np.array(states),
        inputs=np.array(inputs).reshape(-1, len(task.inputs)),
        failed_at=None if failure is None else len(inputs),
        failure=failure,
        measured=seen,
        sensed=record == "measured",
    )
