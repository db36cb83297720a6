"""A planar hopper with one springy leg, from the equations of motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import final

import numpy as np

from simbias.core import Kernel, Nominal, Task
from simbias.core.parameters import replaced, uncertain
from simbias.core.ranges import Acceleration, Inertia, Mass, NonNegative, Positive, TimeStep
from simbias.core.records import Array
from simbias.simulation.compiler import at_least, at_most, elementwise, sincos

# A leg; its upper part turns about the hip, and its lower part, the foot, slides along it.
UPPER_MASS, UPPER_CENTRE = 0.4, 0.12  # kg; m from the hip to the centre of mass
FOOT_MASS, FOOT_CENTRE = 0.2, 0.42
LEG_INERTIA = 0.005  # kg m^2, of both parts about their own centres of mass
LENGTH, RADIUS = 0.47, 0.03  # m from the hip to the centre of the foot's sole, a sphere of this radius
CONTACT_RATE = 100.0  # rad/s, natural frequency of the critically damped contact
EDGE = 1e-4  # m, penetration at which a contact is fully effective
_UNITS = {
    "torso_mass": "kg",
    "torso_inertia": "kg m^2",
    "stiffness": "N/m",
    "damping": "N s/m",
    "hip_damping": "N m s/rad",
    "friction": "1",
}


def _moved(mass, inertia, moment, along, across, turning, sliding):
    """Accelerations of the hip along and across the leg, and of the leg's angle and length, due to forces.

    The torso's centre of mass is at the hip, so motions along and across the leg are independent.
    """
    determinant = mass * inertia - moment * moment
    a_across = (inertia * across - moment * turning) / determinant
    a_angle = (mass * turning - moment * across) / determinant
    a_along = (along - sliding) / (mass - FOOT_MASS)
    return a_along, a_across, a_angle, sliding / FOOT_MASS - a_along


def _accelerations(x, u, parameters):
    """Accelerations of x, z, pitch, hip and spring."""
    _, gravity, torso_mass, torso_inertia, stiffness, damping, hip_damping, friction = parameters
    _, z, pitch, hip, spring, v_x, v_z, d_pitch, d_hip, d_spring = x
    sine, cosine = sincos(pitch + hip)  # the leg points along (-sine, -cosine)
    turn = d_pitch + d_hip
    foot, sole = FOOT_CENTRE + spring, LENGTH + spring
    mass = torso_mass + UPPER_MASS + FOOT_MASS
    moment = UPPER_MASS * UPPER_CENTRE + FOOT_MASS * foot
    inertia = LEG_INERTIA + UPPER_MASS * UPPER_CENTRE * UPPER_CENTRE + FOOT_MASS * foot * foot
    torque = u[0] - hip_damping * d_hip
    coriolis = 2.0 * FOOT_MASS * d_spring * turn
    free = _moved(
        mass,
        inertia,
        moment,
        mass * gravity * cosine + moment * turn * turn,
        -mass * gravity * sine - coriolis,
        torque - gravity * moment * sine - coriolis * foot,
        u[1] - stiffness * spring - damping * d_spring + FOOT_MASS * (gravity * cosine + foot * turn * turn),
    )
    # The sole: velocity and acceleration along and across the leg, and the effect of unit forces there.
    v_along = -sine * v_x - cosine * v_z + d_spring
    v_across = -cosine * v_x + sine * v_z + sole * turn
    a_along = free[0] + free[3] - sole * turn * turn
    a_across = free[1] + sole * free[2] + 2.0 * d_spring * turn
    by_along = _moved(mass, inertia, moment, 1.0, 0.0, 0.0, 1.0)
    by_across = _moved(mass, inertia, moment, 0.0, 1.0, sole, 0.0)
    yields_along, yields_across = by_along[0] + by_along[3], by_across[1] + sole * by_across[2]
    # In world axes: the ground's force (f_x, f_z) stops the sole's sliding and penetration, if it can.
    slip, rise = -sine * v_along - cosine * v_across, -cosine * v_along + sine * v_across
    depth = RADIUS - (z - sole * cosine)
    want_x = -CONTACT_RATE * slip + sine * a_along + cosine * a_across
    want_z = CONTACT_RATE * (CONTACT_RATE * depth - 2.0 * rise) + cosine * a_along - sine * a_across
    m_xx = sine * sine * yields_along + cosine * cosine * yields_across
    m_zz = cosine * cosine * yields_along + sine * sine * yields_across
    m_xz = sine * cosine * (yields_along - yields_across)
    determinant = m_xx * m_zz - m_xz * m_xz
    bears = at_most(at_least(depth / EDGE, 0.0), 1.0)
    f_z = bears * at_least((m_xx * want_z - m_xz * want_x) / determinant, 0.0)
    f_x = at_most(at_least((want_x - m_xz * f_z) / m_xx, -friction * f_z), friction * f_z)
    f_along, f_across = -sine * f_x - cosine * f_z, -cosine * f_x + sine * f_z
    along = free[0] + by_along[0] * f_along
    across = free[1] + by_across[1] * f_across
    angle = free[2] + by_across[2] * f_across
    a_pitch = -torque / torso_inertia
    return (
        -sine * along - cosine * across,
        -cosine * along + sine * across,
        a_pitch,
        angle - a_pitch,
        free[3] + by_along[3] * f_along,
    )


@cache
def _frame(count: int) -> Callable:
    """A frame of `count` steps of the semi-implicit Euler method."""

    def frame(x, u, parameters):
        """States a frame after x under u."""
        h = parameters[0]
        for _ in range(count):
            a = _accelerations(x, u, parameters)
            v = (x[5] + h * a[0], x[6] + h * a[1], x[7] + h * a[2], x[8] + h * a[3], x[9] + h * a[4])
            q = (x[0] + h * v[0], x[1] + h * v[1], x[2] + h * v[2], x[3] + h * v[3], x[4] + h * v[4])
            x = q + v
        return x

    return frame


@final
class Hopper(Nominal):
    """A hopper: states are torso x, z and pitch, hip, spring, and rates; inputs act on hip and spring.

    The leg's angle is pitch + hip, clockwise from straight down; positive spring values lengthen the leg. The
    ground exerts the force that stops the sole, as far as friction and one-sided contact allow.

    Parameters
    ----------
    torso_mass, torso_inertia
        Mass and inertia of the torso, whose centre of mass is at the hip. The leg's masses are constants of
        this module.
    stiffness, damping
        Stiffness and damping of the leg's spring.
    hip_damping, friction
        Damping of the hip, and friction of the sole on the ground.
    uncertainty
        Uncertainty of these by name: the standard deviation of the logarithm or, if a value is zero, of a
        half-normal prior's underlying normal distribution.
    sub_step
        Longest step of the semi-implicit Euler method, in s.

    Raises
    ------
    ValueError
        If the task does not have these states, or no parameter has such a name.
    """

    kernel: Kernel

    def __init__(
        self,
        task: Task,
        torso_mass: Mass,
        torso_inertia: Inertia,
        stiffness: Positive,
        damping: NonNegative = 0.0,
        hip_damping: NonNegative = 0.0,
        friction: NonNegative = 1.0,
        gravity: Acceleration = 9.81,
        uncertainty: dict[str, NonNegative] | None = None,
        sub_step: TimeStep = 0.0025,
    ) -> None:
        units = ["m", "m", "rad", "rad", "m"]
        if [state.unit for state in task.states] != [*units, *(f"{unit}/s" for unit in units)]:
            raise ValueError("expected a task with x, z, pitch, hip, spring and their rates")
        if len(task.inputs) != 2:
            raise ValueError("expected a task with a torque and a force")
        numbers = (torso_mass, torso_inertia, stiffness, damping, hip_damping, friction)
        values = dict(zip(_UNITS, numbers, strict=True))
        self.parameters = uncertain(values, _UNITS, uncertainty or {})
        steps = math.ceil(task.time_step / sub_step - 1e-9)
        self.kernel = Kernel(_frame(steps), np.array([task.time_step / steps, gravity, *numbers]))

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., 10), one frame after x (..., 10) under u (..., 2) in N m and N."""
        return elementwise(self.kernel.function, x, u, parameters=self.kernel.parameters)

    def with_parameters(self, values: Array) -> Hopper:
        """The model with other values (k,) of its parameters."""
        changed = copy(self)
        numbers = replaced(self.kernel.parameters, _UNITS, 2, self.parameters, values)
        changed.kernel = self.kernel._replace(parameters=numbers)
        return changed
