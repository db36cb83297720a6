"""The nominal model of the bongoboard (Section VI-A): Lagrangian equations of motion, Euler steps."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from simbias.config.numbers import MassOrZero, Spread
from simbias.interfaces import Kernel, Nominal
from simbias.nominal.bongoboard_equations import accelerations, coefficients, energy, step
from simbias.records import Array
from simbias.simulation.kernels import elementwise
from simbias.task.bongoboard import Bongoboard, Robot


@dataclass(frozen=True)
class Uncertainty:
    """How well the parameters are known."""

    masses: Spread = 0.0  # standard deviation of the logarithm of each mass and inertia
    foot_mass: MassOrZero = 0.0  # kg; the feet weigh anything from 0 to this


_CERTAIN = Uncertainty()


@final
class LagrangianBongoboard(Nominal):
    """f' of Eq. 1: perfect rolling, perfect joints, feet of `foot_mass` kg glued to the board.

    The kernel's parameters are the time step and the lumped coefficients of the robot, so that a robot with
    other masses needs other parameters only.
    """

    kernel: Kernel

    def __init__(
        self, task: Bongoboard, foot_mass: MassOrZero = 0.0, uncertainty: Uncertainty = _CERTAIN
    ) -> None:
        self._time_step = task.time_step
        self._robot = task.robot
        self._uncertainty = uncertainty
        self.kernel = self._compiled(task.robot, foot_mass)

    def _compiled(self, robot: Robot, foot_mass: float) -> Kernel:
        """The step of a robot whose feet are glued to the board."""
        return Kernel(step, np.concatenate(([self._time_step], coefficients(robot, foot_mass))))

    def draw(self, rng: np.random.Generator) -> LagrangianBongoboard:
        """A model with other masses and inertias, each on its own, as uncertain as declared."""
        masses = {
            name: value for name, value in vars(self._robot).items() if name.endswith(("_mass", "_inertia"))
        }
        factors = np.exp(self._uncertainty.masses * rng.standard_normal(len(masses)))
        robot = replace(self._robot, **dict(zip(masses, factors * list(masses.values()), strict=True)))
        drawn = copy(self)
        drawn.kernel = self._compiled(robot, rng.uniform(0.0, self._uncertainty.foot_mass))
        return drawn

    def step(self, x: Array, u: Array) -> Array:
        """Semi-implicit Euler: x_next (..., 6), one time step after x (..., 6) under u (..., 1) in N m."""
        return elementwise(step, x, u, parameters=self.kernel.parameters)

    def accelerations(self, x: Array, u: Array) -> Array:
        """Accelerations (..., 3) of alpha_w, alpha_b, theta in rad/s^2 at x (..., 6) under u (..., 1)."""
        return elementwise(accelerations, x, u, parameters=self.kernel.parameters)

    def energy(self, x: Array) -> Array:
        """Kinetic and potential energy (...) in J at x (..., 6), heights counted from the wheel's centre."""
        return energy(np.moveaxis(x, -1, 0), self.kernel.parameters)
