"""Gaps between a bongoboard and its model, by name; zero or neutral by default."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Annotated

from pydantic import Field

from simbias.core.ranges import Coordinate, Force, Inertia, Lag, MassOrZero, NonNegative, Positive, Slope
from simbias.simulation.actuator import MOST_TAPS, Actuator
from simbias.simulation.noise import Offsets

Delay = Annotated[int, Field(ge=0, le=MOST_TAPS)]  # frames


@dataclass(frozen=True)
class Gaps:
    """Gaps between the hardware and its model; the model uses the same names for those it covers."""

    slope: Slope = 0.0  # rad; the floor rises towards positive x; angles are relative to its normal
    ankle_damping: NonNegative = 0.0  # N m s/rad
    ankle_stiffness: NonNegative = 0.0  # N m/rad, of a spring at rest at theta = 0
    ankle_friction: NonNegative = 0.0  # N m; Coulomb friction, including stiction
    backlash: Annotated[float, Field(ge=0, le=1)] = 0.0  # rad, full range, between motors and legs
    rotor_inertia: Inertia = 0.01  # kg m^2 of the motors, at the legs; used with backlash
    rolling_resistance: NonNegative = 0.0  # N m, against the wheel's rotation, including stiction
    payload_mass: MassOrZero = 0.0  # kg, a point on the pelvis
    payload_x: Coordinate = 0.0  # m from the pelvis' centre, along the board
    payload_y: Coordinate = 0.0  # m, off the board
    motor_gain: Positive = 1.0
    torque_offset: Coordinate = 0.0  # N m
    torque_limit: Force | None = None  # N m, at which the motor saturates
    lag: Lag = 0.0  # s, time constant of a first-order lag of the torque
    delay: Delay = 0  # frames until the torque acts
    sensor_offset: Offsets = field(default_factory=dict)  # of states by name, in their units
    sensor_delay: Delay = 0  # frames until a state is measured

    def motor(self, time_step: float) -> Actuator:
        """The actuator of the ankle torque."""
        limit = inf if self.torque_limit is None else self.torque_limit
        return Actuator(self.motor_gain, self.torque_offset, limit, self.lag, self.delay * time_step)


NO_GAPS = Gaps()
