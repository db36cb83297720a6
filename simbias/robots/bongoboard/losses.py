"""Equations of motion of the disturbed bongoboard: damping, stiffness, friction and a payload.

The parameters are the time step, those of `LOSSES`, and the lumped coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from simbias.core.records import Array
from simbias.robots.bongoboard.disturbed_equations import accelerations as accelerations_under
from simbias.robots.bongoboard.disturbed_equations import coefficients
from simbias.robots.bongoboard.task import Robot

LOSSES = ("ankle_damping", "ankle_stiffness", "ankle_friction", "rolling_resistance")
DRY = ("ankle_friction", "rolling_resistance")  # losses that do not vanish at rest
_FIRST = 1 + len(LOSSES)  # index of the first lumped coefficient; Numba slices tuples only by constants
_EQUATIONS = len(LOSSES)  # start of the equations' parameters, with a placeholder for the time step
_SLIDING = 0.05  # rad/s, at which dry friction has 0.7 of its strength: a smoothed step


def parameters(robot: Robot, time_step: float, values: Mapping[str, float]) -> Array:
    """Parameters of the equations for these values of `LOSSES`, foot mass, slope and payload.

    Pelvis and payload are one rigid body, with its centre of mass away from the pelvis' middle.
    """
    pelvis, payload = robot.pelvis_mass, values["payload_mass"]
    x, y = values["payload_x"], values["payload_y"]
    mass = pelvis + payload
    share = payload / mass
    inertia = robot.pelvis_inertia + pelvis * share * (x**2 + y**2)
    loaded = replace(robot, pelvis_mass=mass, pelvis_inertia=inertia)
    lumped = coefficients(loaded, values["foot_mass"], values["slope"], share * x, share * y)
    return np.array([time_step, *(values[name] for name in LOSSES), *lumped])


def accelerations(x, u, parameters):
    """Accelerations of alpha_w, alpha_b, theta (rad/s^2) at x (6,) under u (1,)."""
    return accelerations_under(x, _loads(x, u, parameters), parameters[_EQUATIONS:])


def _loads(x, u, parameters):
    """The ankles' torque and the moment on the wheel, in N m."""
    _, damping, stiffness, friction, resistance = parameters[:_FIRST]
    theta, d_alpha_w, d_theta = x[2], x[3], x[5]
    torque = u[0] - damping * d_theta - stiffness * theta - friction * _direction(d_theta)
    return torque, -resistance * _direction(d_alpha_w)


def _direction(rate):
    """The smoothed sign of a rate, from -1 to 1."""
    return rate / np.sqrt(rate * rate + _SLIDING * _SLIDING)
