"""The bongoboard in any physics engine: experiments on it, and their failure."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field

from simbias.core import Hardware, Policy
from simbias.core.records import Array, Rollout
from simbias.robots.bongoboard.bodies import Assembly, Feet, Place, contact
from simbias.robots.bongoboard.gaps import NO_GAPS, Gaps
from simbias.robots.bongoboard.task import Bongoboard, deviations
from simbias.simulation.actuator import Actuators
from simbias.simulation.control_loop import Record, Robot, experiment
from simbias.simulation.noise import Noise, Sensor, Variances

InertiaError = Annotated[float, Field(ge=-0.99, le=100)]
Depth = Annotated[float, Field(ge=1e-9, le=1.0)]  # m

ABSURD = 1e3  # rad, rad/s: reached within a frame only by numerical instability


class World(Protocol):
    """An engine's world, initialised to a start."""

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""

    def state(self) -> list[float]:
        """The task's state (6,), from the bodies' angles and rates."""

    def wheel_and_board(self) -> tuple[Place, Place]:
        """Centre x, y (m) and global angle of wheel and board."""


class EngineBongoboard(Hardware):
    """A bongoboard that is simulated by an engine.

    Parameters
    ----------
    inertia_error
        Every mass and moment of inertia is multiplied by 1 + inertia_error.
    overlap, feet, gaps
        As in its `Assembly`. Gaps of motor and sensors are handled here, the rest in the world.
    noise
        Variances of noise on the torque and on the states that the policy sees, by name (`Noise`).
    record
        The states used by cost and learning: the true ones, or the measured ones, as on a real robot. Failure
        is always judged by the true states, as a person would see the robot fall.
    detachment
        Gap in m above which the board has left the wheel; below it, contacts flicker.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: float,
        noise: Variances,
        record: Record,
        detachment: float,
        overlap: float,
        feet: Feet = "plate",
        gaps: Gaps = NO_GAPS,
    ) -> None:
        self.task = task
        self.detachment = detachment
        self.motor = Actuators([gaps.motor(task.time_step)], task.time_step, gaps.delay)
        self.sensor = Sensor(task, gaps.sensor_offset, gaps.sensor_delay)
        self._assembly = Assembly(task, 1.0 + inertia_error, feet, overlap, gaps)
        self._noise = Noise(task, noise)
        self._record = record

    @abstractmethod
    def build(self, start: Array) -> World:
        """The engine's world at an experiment's start (6,)."""

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment with theta (p,) from start (6,); its cost is not set."""
        robot, noise = _Running(self, start), self._noise.draw(rng)
        return experiment(self.task, robot, policy, theta, noise, self._record)


class _Running(Robot):
    """The running robot; its world is built in the first frame."""

    def __init__(self, hardware: EngineBongoboard, start: Array) -> None:
        self._hardware, self._task, self._motor = hardware, hardware.task, hardware.motor
        self._motor_state = np.zeros(self._motor.state_size)
        self._states = [np.asarray(start, dtype=np.float64)]
        self._limits = [criterion.limit for criterion in self._task.criteria]
        self._world: World | None = None

    def state(self) -> Array:
        """The true state (6,)."""
        return self._states[-1]

    def reading(self) -> Array:
        """Readings (6,) of the sensors, without noise."""
        return self._hardware.sensor.read(self._states, len(self._states) - 1)

    def step(self, u: Array) -> None:
        """Step the world by one frame, under the motor's output for u (1,)."""
        if self._world is None:
            self._world = self._hardware.build(self._states[0])
        if not self._motor.ideal:
            u, self._motor_state = self._motor.acting(u, self._motor_state)
        self._world.step(float(u[0]))
        x = self._world.state()
        stable = all(abs(value) <= ABSURD for value in x)
        self._states.append(np.array(x if stable else [math.nan] * 6))

    def failure(self) -> str | None:
        """The violated criterion of Section IV-C; the contacts (1, 2) are checked in the engine."""
        x = self._states[-1]
        if self._world is None:
            measures = self._task.measure(x).tolist()
        else:
            depth, gap = contact(self._task.robot, *self._world.wheel_and_board())
            measures = (depth, gap - self._hardware.detachment, *deviations(x.tolist()))
        for i, limit in enumerate(self._limits):  # faster than NumPy
            if not measures[i] <= limit:
                return self._task.criteria[i].name
        return None
