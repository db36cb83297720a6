"""A pole on a cart, from the equations of motion."""

from __future__ import annotations

from copy import copy
from typing import final

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.parameters import replaced, uncertain
from simbias.core.ranges import Acceleration, Length, Mass, NonNegative
from simbias.core.records import Array
from simbias.simulation.compiler import elementwise, sincos


def _rates(x, u, parameters):
    """Time derivatives of position, angle and their velocities, for a thin rod hinged on the cart."""
    cart_mass, mass, length, cart_damping, hinge_damping, gravity = parameters
    _, angle, d_position, d_angle = x
    s, c = sincos(angle)
    half = length / 2
    total, coupling, inertia = cart_mass + mass, mass * half * c, mass * length * length / 3
    force = u[0] + mass * half * s * d_angle * d_angle - cart_damping * d_position
    torque = mass * gravity * half * s - hinge_damping * d_angle
    determinant = total * inertia - coupling * coupling
    return (
        d_position,
        d_angle,
        (inertia * force - coupling * torque) / determinant,
        (total * torque - coupling * force) / determinant,
    )


def _moved(x, rates, seconds):
    """The state after a duration in s at these rates."""
    return (
        x[0] + seconds * rates[0],
        x[1] + seconds * rates[1],
        x[2] + seconds * rates[2],
        x[3] + seconds * rates[3],
    )


def _step(x, u, parameters):
    """One frame of the fourth-order Runge-Kutta method, with constant force."""
    seconds, constants = parameters[0], parameters[1:]
    k1 = _rates(x, u, constants)
    k2 = _rates(_moved(x, k1, seconds / 2), u, constants)
    k3 = _rates(_moved(x, k2, seconds / 2), u, constants)
    k4 = _rates(_moved(x, k3, seconds), u, constants)
    mean = (
        (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0]) / 6,
        (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1]) / 6,
        (k1[2] + 2 * k2[2] + 2 * k3[2] + k4[2]) / 6,
        (k1[3] + 2 * k2[3] + 2 * k3[3] + k4[3]) / 6,
    )
    return _moved(x, mean, seconds)


_UNITS = {
    "cart_mass": "kg",
    "pole_mass": "kg",
    "length": "m",
    "cart_damping": "N s/m",
    "hinge_damping": "N m s/rad",
}


@final
class CartPole(Nominal):
    """A thin, uniform pole on a cart: states position, angle (0 upright) and velocities; a force on the cart.

    Parameters
    ----------
    uncertainty
        Uncertainty of `cart_mass`, `pole_mass`, `length`, `cart_damping` and `hinge_damping`: the standard
        deviation of the logarithm or, if a value is zero, of a half-normal prior's underlying normal
        distribution.

    Raises
    ------
    ValueError
        If the task does not have these states, or no parameter has such a name.
    """

    def __init__(
        self,
        task: Task,
        cart_mass: Mass,
        pole_mass: Mass,
        length: Length,
        cart_damping: NonNegative = 0.0,
        hinge_damping: NonNegative = 0.0,
        gravity: Acceleration = 9.81,
        uncertainty: dict[str, NonNegative] | None = None,
    ) -> None:
        if [state.unit for state in task.states] != ["m", "rad", "m/s", "rad/s"] or len(task.inputs) != 1:
            raise ValueError("expected a task with position, angle and their velocities, and one force")
        values = dict(zip(_UNITS, (cart_mass, pole_mass, length, cart_damping, hinge_damping), strict=True))
        self.parameters = uncertain(values, _UNITS, uncertainty or {})
        self._constants = np.array([task.time_step, *values.values(), gravity])

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., 4), one frame after x (..., 4) under u (..., 1) in N."""
        return elementwise(_step, x, u, parameters=self._constants)

    def with_parameters(self, values: Array) -> CartPole:
        """The model with other values (k,) of its parameters."""
        changed = copy(self)
        changed._constants = replaced(self._constants, _UNITS, 1, self.parameters, values)
        return changed
