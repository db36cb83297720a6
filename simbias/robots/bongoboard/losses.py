"""The disturbed bongoboard as a kernel: what damps, springs and rubs, and a payload.

The kernel's parameters are those of `LOSSES`, then the time step and the lumped coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from simbias.core.records import Array
from simbias.robots.bongoboard.disturbed_equations import accelerations as accelerations_under
from simbias.robots.bongoboard.disturbed_equations import coefficients
from simbias.robots.bongoboard.disturbed_equations import energy as energy_of
from simbias.robots.bongoboard.disturbed_equations import step as step_under
from simbias.robots.bongoboard.task import Robot

LOSSES = ("ankle_damping", "ankle_stiffness", "ankle_friction", "rolling_resistance")
_OTHERS = len(LOSSES)  # where the other parameters begin
_SLIDING = 0.05  # rad/s, at which dry friction has 0.7 of its strength: a step that is not sudden


def parameters(robot: Robot, time_step: float, values: Mapping[str, float]) -> Array:
    """Those of the kernel, for these values of `LOSSES`, foot mass, slope and payload.

    Pelvis and payload are one rigid body, whose centre of mass is off the pelvis' middle.
    """
    pelvis, payload = robot.pelvis_mass, values["payload_mass"]
    x, y = values["payload_x"], values["payload_y"]
    mass = pelvis + payload
    share = payload / mass
    inertia = robot.pelvis_inertia + pelvis * share * (x**2 + y**2)
    loaded = replace(robot, pelvis_mass=mass, pelvis_inertia=inertia)
    lumped = coefficients(loaded, values["foot_mass"], values["slope"], share * x, share * y)
    return np.array([*(values[name] for name in LOSSES), time_step, *lumped])


def energy(x, parameters):
    """Energy (J) at x (6,), its potential part counted from the height of the wheel's centre."""
    return energy_of(x, parameters[_OTHERS:])


def accelerations(x, u, parameters):
    """Accelerations of alpha_w, alpha_b, theta (rad/s^2) at x (6,) under u (1,)."""
    return accelerations_under(x, _loads(x, u, parameters), parameters[_OTHERS:])


def step(x, u, parameters):
    """Semi-implicit Euler: x_next (6,) after x (6,) under u (1,)."""
    return step_under(x, _loads(x, u, parameters), parameters[_OTHERS:])


def _loads(x, u, parameters):
    """The ankles' torque and the moment on the wheel, in N m."""
    damping, stiffness, friction, resistance = parameters[:_OTHERS]
    theta, d_alpha_w, d_theta = x[2], x[3], x[5]
    torque = u[0] - damping * d_theta - stiffness * theta - friction * _direction(d_theta)
    return torque, -resistance * _direction(d_alpha_w)


def _direction(rate):
    """-1 to 1, the sign of a rate that is not small."""
    return rate / np.sqrt(rate * rate + _SLIDING * _SLIDING)
