"""The nominal model of the bongoboard (Section VI-A): Lagrangian equations of motion, Euler steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, final

import numpy as np

from simbias.core import Kernel, Nominal
from simbias.core.parameters import Parameter, Prior, values_at
from simbias.core.ranges import Lag, MassOrZero, NonNegative, SlopeSpread, Spread
from simbias.core.records import Array
from simbias.robots.bongoboard import equations, losses
from simbias.robots.bongoboard.task import Bongoboard, Robot
from simbias.simulation.actuator import Actuator, Actuators, taps_of
from simbias.simulation.compiler import elementwise

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
_CERTAIN = Uncertainty()


@final
class LagrangianBongoboard(Nominal):
    """f' of Eq. 1: perfect rolling, perfect joints, feet of `foot_mass` kg glued to the board.

    The kernel's parameters are the time step and the robot's lumped coefficients, so that other masses change
    only parameters. It is no faster than the trace of `step`, but rounds as in the published trials. Slope,
    losses, payload and motor are absent, at no cost, unless they are uncertain.

    Parameters
    ----------
    sampled
        Names of the uncertainties that `draw` samples; None: all. The others stay as declared until they are
        identified, as no policy may hold on everything that a wide prior allows.

    Raises
    ------
    ValueError
        If the delay may be too many frames, or a name belongs to no uncertainty.
    """

    kernel: Kernel

    def __init__(
        self,
        task: Bongoboard,
        foot_mass: MassOrZero = 0.0,
        uncertainty: Uncertainty = _CERTAIN,
        sampled: list[str] | None = None,
    ) -> None:
        self._time_step = task.time_step
        self._robot = task.robot
        self._drawn = uncertainty if sampled is None else only(sampled, uncertainty)
        self._taps = taps_of(uncertainty.delay, task.time_step)
        self._declared = declared(task.robot, foot_mass)
        self.parameters = tuple(priors(task.robot, float(task.input_limit[0]), uncertainty))
        self._names = [parameter.name for parameter in self.parameters]
        self._build({}, self._names if sampled is None else sampled)

    def _build(self, values: Mapping[str, float], present: Collection[str]) -> None:
        """Build the kernel from values of some parameters, with the others as declared.

        It includes losses, payload and motor only as far as they are present.
        """
        self._known = known = {**self._declared, **values}
        self._present = present
        robot = replace(self._robot, **{name: known[name] for name in MASSES})
        self._is_disturbed = not MECHANICAL.keys().isdisjoint(present)
        if self._is_disturbed:
            parameters = losses.parameters(robot, self._time_step, known)
        else:
            parameters = np.array([self._time_step, *equations.coefficients(robot, known["foot_mass"])])
        mechanics = Kernel(_semi_implicit(self._equations.accelerations), parameters)
        self._mechanics = self.kernel = mechanics
        self._actuators: Actuators | None = None
        self.state_size = 0
        if not MOTOR.keys().isdisjoint(present):
            motor = Actuator(*(known[name] for name in MOTOR))
            self._actuators = Actuators([motor], self._time_step, self._taps)
            self.kernel = self._actuators.before(mechanics)
            self.state_size = self._actuators.state_size

    def with_parameters(self, values: Array) -> LagrangianBongoboard:
        """The model with other values (k,) of its `parameters`."""
        return self._with(dict(zip(self._names, values.tolist(), strict=True)), self._names)

    def _with(self, values: Mapping[str, float], present: Collection[str]) -> LagrangianBongoboard:
        changed = copy(self)
        changed._build(values, present)
        return changed

    def without_dry_friction(self) -> LagrangianBongoboard:
        """The model without ankle friction and rolling resistance."""
        return self._with({**self._known, **dict.fromkeys(losses.DRY, 0.0)}, self._present)

    def draw(self, rng: np.random.Generator) -> LagrangianBongoboard:
        """Draw a model from the declared uncertainty: masses and inertias independently, the feet, the rest.

        Further uncertainties do not change the earlier draws.
        """
        uncertainty = self._drawn
        masses = [*MASSES[:2], "foot_mass", *MASSES[2:]]  # includes an unused draw for the feet
        factors = np.exp(uncertainty.masses * rng.standard_normal(len(masses)))
        drawn = dict(zip(masses, (factors * [self._declared[name] for name in masses]).tolist(), strict=True))
        foot_mass = rng.uniform(0.0, uncertainty.foot_mass)
        drawn["foot_mass"] = foot_mass if uncertainty.foot_mass else self._declared["foot_mass"]
        others = [
            each for each in self.parameters if each.name not in drawn and getattr(uncertainty, each.name)
        ]
        values = values_at(others, rng.standard_normal(len(others))).tolist()
        drawn |= {parameter.name: value for parameter, value in zip(others, values, strict=True)}
        present = [each.name for each in self.parameters if getattr(uncertainty, each.name, 0)]
        return self._with(drawn, present)

    def step(self, x: Array, u: Array) -> Array:
        """Semi-implicit Euler: x_next (..., 6), one time step after x (..., 6) under u (..., 1) in N m."""
        return self._stepped(x, u if self._actuators is None else self._actuators.settled(u))

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """x_next (..., 6) under the motor's output for u (..., 1), and the model state (..., s)."""
        if self._actuators is None:
            return self._stepped(x, u), model_state
        acting, model_state = self._actuators.acting(u, model_state)
        return self._stepped(x, acting), model_state

    def model_states(self, states: Array, inputs: Array) -> Array:
        """The model state (k, s), that of the motor, in each frame of a record."""
        return np.empty((len(inputs), 0)) if self._actuators is None else self._actuators.model_states(inputs)

    def _stepped(self, x: Array, torque: Array) -> Array:
        """x_next (..., 6) under an acting torque (..., 1)."""
        return elementwise(self._mechanics.function, x, torque, parameters=self._mechanics.parameters)

    @property
    def _equations(self) -> Any:
        return losses if self._is_disturbed else equations

    def accelerations(self, x: Array, u: Array) -> Array:
        """Accelerations (..., 3) of alpha_w, alpha_b, theta in rad/s^2 at x (..., 6), acting u (..., 1)."""
        return elementwise(self._equations.accelerations, x, u, parameters=self._mechanics.parameters)


@cache
def _semi_implicit(accelerations: Callable) -> Callable:
    """A step of semi-implicit Euler: velocities first, then positions; the time step is parameter 0."""

    def step(x, u, parameters):
        """x_next (6,) after x (6,) under u (1,)."""
        time_step = parameters[0]
        alpha_w, alpha_b, theta, d_alpha_w, d_alpha_b, d_theta = x
        dd_alpha_w, dd_alpha_b, dd_theta = accelerations(x, u, parameters)
        d_alpha_w = d_alpha_w + time_step * dd_alpha_w
        d_alpha_b = d_alpha_b + time_step * dd_alpha_b
        d_theta = d_theta + time_step * dd_theta
        return (
            alpha_w + time_step * d_alpha_w,
            alpha_b + time_step * d_alpha_b,
            theta + time_step * d_theta,
            d_alpha_w,
            d_alpha_b,
            d_theta,
        )

    return step


def only(names: Sequence[str], uncertainty: Uncertainty) -> Uncertainty:
    """The uncertainty restricted to these names; ValueError if a name belongs to none."""
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
