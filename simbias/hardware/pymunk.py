"""The bongoboard in pymunk, a 2D physics engine in place of the robot (Section VI-A)."""

from __future__ import annotations

import math
from typing import Annotated, Literal, final

import numpy as np
from pydantic import Field

from simbias.config.numbers import Count
from simbias.hardware.pymunk_gaps import NO_GAPS, Gaps
from simbias.hardware.pymunk_world import Feet, World
from simbias.interfaces import Hardware, HardwareError, Policy
from simbias.records import Array, Rollout
from simbias.simulation.actuator import Actuators, Drive
from simbias.simulation.noise import QUIET, Noise, Variances
from simbias.simulation.sensor import Sensor
from simbias.task.bongoboard import Bongoboard

Record = Literal["true_state", "measured"]
Depth = Annotated[float, Field(ge=1e-9, le=1.0)]  # m

BLOW_UP = "physics_engine_blew_up"
_ABSURD = 1e3  # rad, rad/s: no body gets there within a frame but by numerical instability


@final
class PymunkBongoboard(Hardware):
    """Wheel, board, feet, two legs and pelvis as rigid bodies; the feet stand on the board by contact alone.

    Parameters
    ----------
    task
        Geometry, masses, time step (a frame is one step of the engine) and failure.
    inertia_error
        Every mass and moment of inertia is multiplied by 1 + inertia_error.
    feet
        "plate": one plate under both ankles; "separate": the plate cut in two, an ankle above the middle of
        each half; "fixed": the plate joined to the board, as in the Lagrangian model.
    noise
        Variances on the torque and on what the policy sees, by name (`Noise`).
    record
        What cost and learning get to see: the true states, or the measured ones, as of a real robot. Failure
        is judged by the true states all the same: someone sees the robot fall.
    iterations
        Of the engine's solver in each frame.
    overlap
        How deep, in m, bodies in contact may overlap.
    detachment
        Gap, in m, above which the board has left the wheel; contacts flicker below it.
    gaps
        What it has and its model has not (`Gaps`). Noise on the torque passes the motor, too.
    """

    def __init__(
        self,
        task: Bongoboard,
        inertia_error: Annotated[float, Field(ge=-0.99, le=100)] = 0.0,
        feet: Feet = "plate",
        noise: Variances = QUIET,
        record: Record = "true_state",
        iterations: Count = 50,
        overlap: Depth = 1e-4,
        detachment: Depth = 1e-3,
        gaps: Gaps = NO_GAPS,
    ) -> None:
        self._task = task
        self._scale = 1.0 + inertia_error
        self._feet = feet
        self._noise = Noise(task, noise)
        self._sensed = record == "measured"
        self._iterations = iterations
        self._overlap = overlap
        self._detachment = detachment
        self._gaps = gaps
        self._motor = Actuators([gaps.motor(task.time_step)], task.time_step, gaps.delay)
        self._sensor = Sensor(task, gaps.sensor_offset, gaps.sensor_delay)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,) from start (6,); its cost is not set."""
        if not np.isfinite(start).all():
            raise HardwareError(f"the robot cannot start at {start}")
        horizon, n, m = self._task.horizon, 6, 1
        noise = self._noise.draw(rng)
        states, inputs = np.empty((horizon + 1, n)), np.empty((horizon, m))
        measured = np.empty_like(states)
        states[0] = start
        measured[0] = self._sensor.read(states, 0) + noise.sensors[0]
        failure = self._task.failure(states[0])
        if failure is not None:
            return self._record(states[:1], inputs[:0], measured[:1], failure)
        world = self.build(states[0])
        controller, motor = policy.controller(theta, self._task.time_step), Drive(self._motor)
        t = 0
        while failure is None and t < horizon:
            inputs[t] = controller(measured[t])
            torque = float(inputs[t, 0])
            if not math.isfinite(torque):
                raise HardwareError(f"in frame {t} the policy asks for a torque of {torque}")
            (acting,) = motor((torque + noise.inputs[t, 0],))
            world.step(acting, self._task.time_step)
            x = world.state()
            if not all(abs(value) <= _ABSURD for value in x):
                failure = BLOW_UP  # x is no state; the record ends with the one before
                break
            t += 1
            states[t] = x
            measured[t] = self._sensor.read(states, t) + noise.sensors[t]
            failure = self._failure(states[t], world)
        return self._record(states[: t + 1], inputs[:t], measured[: t + 1], failure)

    def build(self, start: Array) -> World:
        """The engine's world at a start (6,), as an experiment begins with it."""
        return World(self._task, start, self._scale, self._feet, self._iterations, self._overlap, self._gaps)

    def _record(self, states: Array, inputs: Array, measured: Array, failure: str | None) -> Rollout:
        """The record of states (k+1, 6), true and measured, and inputs (k, 1), up to failure or horizon."""
        return Rollout(
            states=measured if self._sensed else states,
            inputs=inputs,
            failed_at=None if failure is None else len(inputs),
            failure=failure,
            measured=measured,
            sensed=self._sensed,
        )

    def _failure(self, x: Array, world: World) -> str | None:
        """Name of the criterion of Section IV-C that x (6,) violates; contacts (1, 2) are the engine's."""
        measures = self._task.measure(x).tolist()
        depth, gap = world.contact()
        measures[:2] = depth, gap - self._detachment
        for measure, criterion in zip(measures, self._task.criteria, strict=True):  # quicker than in NumPy
            if not measure <= criterion.limit:
                return criterion.name
        return None
