"""Uncertain parameters of the bongoboard's model: names, units and priors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

from simbias.core.parameters import Parameter, Prior
from simbias.core.ranges import Lag, MassOrZero, NonNegative, SlopeSpread, Spread
from simbias.robots.bongoboard.task import Robot

MASSES = ("wheel_mass", "board_mass", "leg_mass", "pelvis_mass", "pelvis_inertia")


@dataclass(frozen=True)
class Uncertainty:
    """Spreads of the priors (`simbias.core.parameters`); 0: known exactly."""

    masses: Spread = 0.0  # log-normal, of each mass and inertia
    foot_mass: MassOrZero = 0.0  # kg, uniform: the feet weigh anything from 0 to this
    slope: SlopeSpread = 0.0  # rad, normal: the floor rises towards positive x
    ankle_damping: NonNegative = 0.0  # N m s/rad, half-normal
    ankle_stiffness: NonNegative = 0.0  # N m/rad, half-normal: a spring at rest at theta = 0
    ankle_friction: NonNegative = 0.0  # N m, half-normal: Coulomb friction
    rolling_resistance: NonNegative = 0.0  # N m, half-normal: a moment against the wheel's rotation
    payload_mass: MassOrZero = 0.0  # kg, half-normal: a point on the pelvis
    payload_x: NonNegative = 0.0  # m, normal: from the pelvis' centre, along the board
    payload_y: NonNegative = 0.0  # m, normal: off the board
    motor_gain: Spread = 0.0  # log-normal
    torque_offset: NonNegative = 0.0  # N m, normal
    torque_limit: NonNegative = 0.0  # N m, uniform: largest reduction of the motor's limit from the task's
    lag: Lag = 0.0  # s, half-normal: first-order lag of the torque
    delay: Lag = 0.0  # s, uniform: the torque acts up to this much later


MECHANICAL: dict[str, tuple[str, Prior]] = {  # unit and prior
    "slope": ("rad", "normal"),
    "ankle_damping": ("N m s/rad", "half_normal"),
    "ankle_stiffness": ("N m/rad", "half_normal"),
    "ankle_friction": ("N m", "half_normal"),
    "rolling_resistance": ("N m", "half_normal"),
    "payload_mass": ("kg", "half_normal"),
    "payload_x": ("m", "normal"),
    "payload_y": ("m", "normal"),
}
MOTOR: dict[str, tuple[str, Prior]] = {
    "motor_gain": ("1", "log_normal"),
    "torque_offset": ("N m", "normal"),
    "torque_limit": ("N m", "uniform"),
    "lag": ("s", "half_normal"),
    "delay": ("s", "uniform"),
}


def only(names: Sequence[str], uncertainty: Uncertainty) -> Uncertainty:
    """The uncertainty restricted to these names.

    Raises
    ------
    ValueError
        If a name belongs to no uncertainty.
    """
    known = [each.name for each in fields(Uncertainty)]
    for name in names:
        if name not in known:
            raise ValueError(f"sampled: no uncertainty is called {name}; available: {', '.join(known)}")
    return Uncertainty(**{name: getattr(uncertainty, name) for name in names})


def declared(robot: Robot, foot_mass: float) -> dict[str, float]:
    """The value of every parameter before identification: zero, or neutral."""
    masses = {name: float(getattr(robot, name)) for name in MASSES}
    motor = dict.fromkeys(MOTOR, 0.0) | {"motor_gain": 1.0, "torque_limit": math.inf}
    return {**masses, "foot_mass": foot_mass, **dict.fromkeys(MECHANICAL, 0.0), **motor}


def priors(robot: Robot, torque_limit: float, uncertainty: Uncertainty) -> Iterator[Parameter]:
    """The priors of uncertain parameters; masses first, the feet's last among them."""
    if uncertainty.masses:
        for name in MASSES:
            unit = "kg m^2" if name.endswith("inertia") else "kg"
            yield Parameter(name, unit, getattr(robot, name), uncertainty.masses, "log_normal")
    if uncertainty.foot_mass:
        yield Parameter("foot_mass", "kg", 0.0, uncertainty.foot_mass, "uniform")
    for name, (unit, prior) in {**MECHANICAL, **MOTOR}.items():
        spread = getattr(uncertainty, name)
        if spread and name == "torque_limit":
            spread = min(spread, torque_limit)
            yield Parameter(name, unit, torque_limit - spread, spread, prior)
        elif spread:
            yield Parameter(name, unit, 1.0 if prior == "log_normal" else 0.0, spread, prior)
