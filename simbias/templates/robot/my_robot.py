"""A custom robot: the task, the nominal model, and the robot itself.

It is a pole on a motor, to be held upright: replace it with yours, piece by piece. `python -m simbias check`
reports what does not fit yet. simbias/core/ holds every contract; all arrays hold floats, in the task's
units.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from simbias.core import Criterion, Hardware, Nominal, Policy, Quantity, Task
from simbias.core.parameters import Parameter
from simbias.core.ranges import Frames, Length, Mass, TimeStep
from simbias.core.records import Array, Rollout

GRAVITY = 9.81  # m/s^2


class Upright(Task):
    """Hold the pole upright for `horizon` frames of `time_step` seconds."""

    states = (Quantity("angle", "rad", "angle"), Quantity("rate", "rad/s", "velocity"))
    inputs = (Quantity("torque", "N m", "torque"),)
    outputs = states  # what the policy feeds back
    criteria = (Criterion("fallen", "the pole has fallen", 0.5, "rad", {"angle": 0.5}),)
    input_limit = np.array([8.0])
    start_mean = np.array([0.1, 0.0])
    start_deviation = np.array([0.05, 0.05])

    def __init__(self, time_step: TimeStep = 0.01, horizon: Frames = 300) -> None:
        self.time_step = time_step
        self.horizon = horizon

    def measure(self, x: Array) -> Array:
        """Measures (..., 1) of the criteria at states x (..., 2)."""
        return np.abs(x[..., :1])

    def output(self, x: Array) -> Array:
        """Outputs z (..., 2) at states x (..., 2)."""
        return x.copy()


class Belief(Nominal):
    """Your simulation model f'. `parameters` are the values that you don't know exactly, with their spreads.

    It is compiled as long as it is ordinary NumPy, with np.where instead of `if`
    (simbias/simulation/compiler/kernels.py).
    """

    def __init__(self, task: Upright, mass: Mass = 1.0, length: Length = 0.5) -> None:
        self._task = task
        self.parameters = (
            Parameter("mass", "kg", mass, 0.2, "log_normal"),
            Parameter("length", "m", length, 0.1, "log_normal"),
        )
        self._mass, self._length = mass, length

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., 2), one time step after x (..., 2) under u (..., 1)."""
        angle, rate = x[..., 0], x[..., 1]
        inertia = self._mass * self._length**2
        acceleration = GRAVITY / self._length * np.sin(angle) + u[..., 0] / inertia
        rate = rate + self._task.time_step * acceleration
        return np.stack([angle + self._task.time_step * rate, rate], axis=-1)

    def with_parameters(self, values: Array) -> Belief:
        """The model with another mass and length."""
        return Belief(self._task, *map(float, values))


class Robot(Hardware):
    """The robot. This one is also simulated: its pole is longer, its joint has friction, a cable pulls."""

    def __init__(
        self,
        task: Upright,
        length: Length = 0.65,
        friction: Annotated[float, Field(ge=0, le=100)] = 0.3,  # N m s
        cable: Annotated[float, Field(ge=-100, le=100)] = 1.0,  # N m, with which it pulls
    ) -> None:
        self._task = task
        self._length = length
        self._friction = friction
        self._cable = cable

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment: on a real robot, send u, wait for the next frame, and read x."""
        task = self._task
        controller = policy.controller(theta, task.time_step)
        states, inputs = [start], list[Array]()
        failure = task.failure(start)
        while failure is None and len(inputs) < task.horizon:
            u = controller(states[-1])
            states.append(self._move(states[-1], u))
            inputs.append(u)
            failure = task.failure(states[-1])
        return Rollout(
            states=np.array(states),
            inputs=np.array(inputs).reshape(-1, 1),
            failed_at=None if failure is None else len(inputs),
            failure=failure,
        )

    def stop(self) -> None:
        """Bring the robot to rest: an experiment took too long, or a limit was exceeded.

        A sweep then needs `engine=sequential`. Delete this method if the robot is only simulated.
        """

    def _move(self, x: Array, u: Array) -> Array:
        """State (2,) a frame after x (2,) under u (1,), with the cable and the friction."""
        torque = u[0] + self._cable - self._friction * x[1]
        acceleration = GRAVITY / self._length * np.sin(x[0]) + torque / self._length**2
        rate = x[1] + self._task.time_step * acceleration
        return np.array([x[0] + self._task.time_step * rate, rate])
