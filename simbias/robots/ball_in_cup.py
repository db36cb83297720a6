"""A ball in a cup, hanging from it on a string, in a vertical plane; from the equations of motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import final

import numpy as np

from simbias.core import Kernel, Nominal, Task
from simbias.core.parameters import replaced, uncertain
from simbias.core.ranges import Acceleration, Length, Mass, NonNegative, Positive, TimeStep
from simbias.core.records import Array
from simbias.simulation.compiler import at_least, at_most, elementwise

RISE, FLARE, DEPTH = 0.04, 0.07, 0.08  # m: half the bottom's width, half the rim's, the cup's height
REACH = 0.033  # m, distance at contact from the ball's centre to the middle of a wall
SLIP = 0.02  # m/s, at which friction reaches two thirds of its size
EDGE = 1e-4  # m, penetration at which a contact is fully effective
_UNITS = {
    "cup_mass": "kg",
    "ball_mass": "kg",
    "string": "m",
    "damping": "N s/m",
    "friction": "1",
    "string_rate": "rad/s",
    "contact_rate": "rad/s",
}


def _touched(x, z, v_x, v_z, from_x, from_z, along_x, along_z, rate, friction):
    """The acceleration of a ball by a wall from a point along a vector; x and v are relative to the cup.

    A contact is a one-sided, critically damped spring with smooth Coulomb friction.
    """
    off_x, off_z = x - from_x, z - from_z
    share = (off_x * along_x + off_z * along_z) / (along_x * along_x + along_z * along_z)
    share = at_most(at_least(share, 0.0), 1.0)
    off_x, off_z = off_x - share * along_x, off_z - share * along_z
    distance = np.sqrt(off_x * off_x + off_z * off_z + 1e-12)
    n_x, n_z = off_x / distance, off_z / distance
    depth = REACH - distance
    normal, slip = n_x * v_x + n_z * v_z, n_x * v_z - n_z * v_x
    bears = at_most(at_least(depth / EDGE, 0.0), 1.0)
    push = bears * at_least(rate * rate * depth - 2.0 * rate * normal, 0.0)
    drag = -friction * push * slip / np.sqrt(slip * slip + SLIP * SLIP)
    return push * n_x - drag * n_z, push * n_z + drag * n_x


def _accelerations(x, u, parameters):
    """Accelerations of the cup and of the ball."""
    _, gravity, cup_mass, ball_mass, string, damping, friction, string_rate, rate = parameters
    cup_x, cup_z, ball_x, ball_z, cup_v_x, cup_v_z, ball_v_x, ball_v_z = x
    x, z, v_x, v_z = ball_x - cup_x, ball_z - cup_z, ball_v_x - cup_v_x, ball_v_z - cup_v_z
    distance = np.sqrt(x * x + z * z + 1e-12)
    n_x, n_z = x / distance, z / distance
    stretch = distance - string
    taut = at_most(at_least(stretch / EDGE, 0.0), 1.0)
    along = n_x * v_x + n_z * v_z
    pull = -taut * at_least(string_rate * string_rate * stretch + 2.0 * string_rate * along, 0.0)
    b_x, b_z = _touched(x, z, v_x, v_z, -RISE, 0.0, 2.0 * RISE, 0.0, rate, friction)
    l_x, l_z = _touched(x, z, v_x, v_z, -RISE, 0.0, RISE - FLARE, DEPTH, rate, friction)
    r_x, r_z = _touched(x, z, v_x, v_z, RISE, 0.0, FLARE - RISE, DEPTH, rate, friction)
    reduced = cup_mass * ball_mass / (cup_mass + ball_mass)
    f_x = reduced * (pull * n_x + b_x + l_x + r_x)
    f_z = reduced * (pull * n_z + b_z + l_z + r_z)
    return (
        (u[0] - damping * cup_v_x - f_x) / cup_mass,
        (u[1] - damping * cup_v_z - f_z) / cup_mass,
        f_x / ball_mass,
        f_z / ball_mass - gravity,
    )


@cache
def _frame(count: int) -> Callable:
    """A frame of `count` steps of the semi-implicit Euler method."""

    def frame(x, u, parameters):
        """States a frame after x under u."""
        h = parameters[0]
        for _ in range(count):
            a_x, a_z, b_x, b_z = _accelerations(x, u, parameters)
            v_x, v_z, w_x, w_z = x[4] + h * a_x, x[5] + h * a_z, x[6] + h * b_x, x[7] + h * b_z
            x = (x[0] + h * v_x, x[1] + h * v_z, x[2] + h * w_x, x[3] + h * w_z, v_x, v_z, w_x, w_z)
        return x

    return frame


@final
class BallInCup(Nominal):
    """A ball in a cup: states are x and z of cup and ball and their velocities; inputs are forces on the cup.

    The cup consists of three straight walls; rails support its weight. String and walls are stiff, critically
    damped springs. All lengths except the string's are constants of this module.

    Parameters
    ----------
    string
        Length of the string in m.
    damping, friction
        Damping of the cup's rails, and friction of the ball on the cup.
    string_rate, contact_rate
        Natural frequencies of the string's and the walls' springs, in rad/s.
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
        cup_mass: Mass,
        ball_mass: Mass,
        string: Length,
        damping: NonNegative = 0.0,
        friction: NonNegative = 0.5,
        gravity: Acceleration = 9.81,
        string_rate: Positive = 100.0,
        contact_rate: Positive = 100.0,
        uncertainty: dict[str, NonNegative] | None = None,
        sub_step: TimeStep = 0.002,
    ) -> None:
        if [state.unit for state in task.states] != ["m"] * 4 + ["m/s"] * 4 or len(task.inputs) != 2:
            raise ValueError(
                "expected a task with the positions of a cup and a ball, their velocities, and two forces"
            )
        given = (cup_mass, ball_mass, string, damping, friction, string_rate, contact_rate)
        values = dict(zip(_UNITS, given, strict=True))
        self.parameters = uncertain(values, _UNITS, uncertainty or {})
        steps = math.ceil(task.time_step / sub_step - 1e-9)
        numbers = np.array([task.time_step / steps, gravity, *values.values()])
        self.kernel = Kernel(_frame(steps), numbers)

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., 8), one frame after x (..., 8) under u (..., 2) in N."""
        return elementwise(self.kernel.function, x, u, parameters=self.kernel.parameters)

    def with_parameters(self, values: Array) -> BallInCup:
        """The model with other values (k,) of its parameters."""
        changed = copy(self)
        numbers = replaced(self.kernel.parameters, _UNITS, 2, self.parameters, values)
        changed.kernel = self.kernel._replace(parameters=numbers)
        return changed
