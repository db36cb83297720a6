"""Motors and sensors between a robot's mechanics and its record, with uncertain parameters.

    y = offset + gain x,    x' = f'(x, acting - friction),    acting = motor(u)

A state x is recorded as y. A motor has gain, offset, lag and delay (`simbias.simulation.actuator`), and gear
friction beyond the model's: Stribeck friction, which falls with velocity, and friction proportional to the
torque. A delay common to all sensors counts as the motors' delay: in a record they are indistinguishable. A
zero, of a motor or a sensor, is an offset that differs between recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np

from simbias.core import Kernel, Nominal, Quantity, Task
from simbias.core.parameters import Parameter, Prior
from simbias.core.ranges import Lag, NonNegative, Spread
from simbias.core.records import Array
from simbias.simulation.actuator import Actuator, Actuators, taps_of
from simbias.simulation.compiler import elementwise, function_of

STRIBECK = 0.2  # rad/s or m/s, at which Stribeck friction has halved; recordings determine it poorly
SMOOTH = 0.02  # rad/s or m/s, range in which friction changes its sign
MOST_DELAY = 4.0  # upper limit of a delay, in prior deviations
_PRIORS: dict[str, tuple[str, float, Prior]] = {  # unit, or "" for the signal's; value; distribution
    "gain": ("1", 1.0, "log_normal"),
    "offset": ("", 0.0, "normal"),
    "zero": ("", 0.0, "normal"),
    "lag": ("s", 0.0, "half_normal"),
    "delay": ("s", 0.0, "half_normal"),
    "stribeck": ("", 0.0, "half_normal"),
    "load": ("1", 0.0, "half_normal"),
}


@dataclass(frozen=True)
class Motor:
    """The uncertainty of a motor: standard deviations; half-normal except gain, offset and zero."""

    gain: Spread = 0.0  # of the gain's logarithm
    offset: NonNegative = 0.0  # in the input's unit
    lag: Lag = 0.0  # s
    delay: Lag = 0.0  # s
    velocity: str | None = None  # the velocity state that its friction acts on
    stribeck: NonNegative = 0.0  # friction at rest beyond that in motion, in the input's unit
    load: NonNegative = 0.0  # friction relative to the torque
    zero: NonNegative = 0.0  # of an offset that differs between recordings

    @property
    def may_exceed_commands(self) -> bool:
        """Whether the acting input may exceed the command, even at its limit."""
        return any((self.gain, self.offset, self.zero, self.stribeck, self.load))


@dataclass(frozen=True)
class Sensor:
    """The uncertainty of a sensor: standard deviations."""

    gain: Spread = 0.0  # of the gain's logarithm
    offset: NonNegative = 0.0  # in the state's unit
    zero: NonNegative = 0.0  # of an offset that differs between recordings, as after switching on


@final
class Rig(Nominal):
    """A nominal model with additional parameters of motors and sensors: `tau1.gain`, `pos1.offset`.

    Some of the model's own parameters, such as a payload, may differ between recordings (`each`, by name).

    Raises
    ------
    ValueError
        As for `check_signals`; also if motors are declared for a model that already has them, if the model
        has no parameter of a given name, or if the rig has a parameter of the same name.
    """

    def __init__(
        self,
        task: Task,
        nominal: Nominal,
        motors: Mapping[str, Motor],
        sensors: Mapping[str, Sensor],
        each: Sequence[str] = (),
    ) -> None:
        check_signals(task, motors, sensors)
        states, inputs = _names(task.states), _names(task.inputs)
        _check_names(each, _names(nominal.parameters), "identification.each")
        if motors and nominal.state_size:
            raise ValueError("identification.motors: the nominal model has its own lag and delay")
        stronger = any(motor.may_exceed_commands for motor in motors.values())
        self.mechanics = nominal.without_input_limits() if stronger else nominal  # between motors and sensors
        self._time_step = task.time_step
        self._states, self._inputs = states, inputs
        brakes = [motors[u].velocity if u in motors else None for u in inputs]
        self._brakes = tuple(None if name is None else states.index(name) for name in brakes)
        self._taps = _taps(task, motors)
        own = [*_parameters(task.inputs, motors, task.states), *_parameters(task.states, sensors)]
        shared = [p._replace(of_recording=p.of_recording or p.name in each) for p in nominal.parameters]
        self.parameters = (*shared, *own)
        if twice := {p.name for p in own} & {p.name for p in shared}:
            raise ValueError(f"identification: {min(twice)} is uncertain in nominal.uncertainty, too")
        self._values = {parameter.name: parameter.value for parameter in own}
        self._has_motors = bool(motors)
        self._assemble()

    def _assemble(self) -> None:
        """Set up motors, numbers and the kernel for the rig's values."""
        v = self._values
        actuators = [
            Actuator(
                v.get(f"{u}.gain", 1.0),
                v.get(f"{u}.offset", 0.0) + v.get(f"{u}.zero", 0.0),
                lag=v.get(f"{u}.lag", 0.0),
                delay=v.get(f"{u}.delay", 0.0),
            )
            for u in self._inputs
        ]
        self._actuators = (
            Actuators(actuators, self._time_step, self._taps, averaged=True) if self._has_motors else None
        )
        self.state_size = self._actuators.state_size if self._actuators else self.mechanics.state_size
        self.acting = self.mechanics.acting  # a model with a model state has no motors here
        self._numbers = np.array(
            [
                *(v.get(f"{x}.offset", 0.0) + v.get(f"{x}.zero", 0.0) for x in self._states),
                *(v.get(f"{x}.gain", 1.0) for x in self._states),
                *(v.get(f"{u}.stribeck", 0.0) for u in self._inputs),
                *(v.get(f"{u}.load", 0.0) for u in self._inputs),
            ]
        )
        self.kernel = None
        if (mechanics := self.mechanics.kernel) is not None:
            remembers = self.mechanics.state_size > 0
            function = _recorded(mechanics.function, len(self._states), self._brakes, remembers)
            recorded = Kernel(function, np.concatenate([self._numbers, mechanics.parameters]))
            self.kernel = self._actuators.before(recorded) if self._actuators else recorded

    def step(self, x: Array, u: Array) -> Array:
        """y_next (..., n) after a record x (..., n), as if u (..., m) had acted for long."""
        acting = self._actuators.settled(u) if self._actuators else u
        return self._record(self.mechanics.step(*self._truth(x, acting)))

    def advance(self, x: Array, u: Array, model_state: Array) -> tuple[Array, Array]:
        """y_next (..., n), and the model state (..., s) for the next frame."""
        if self._actuators:
            acting, model_state = self._actuators.acting(u, model_state)
            return self._record(self.mechanics.step(*self._truth(x, acting))), model_state
        x_next, model_state = self.mechanics.advance(*self._truth(x, u), model_state)
        return self._record(x_next), model_state

    def model_states(self, states: Array, inputs: Array) -> Array:
        """Model states (k, s) in each frame of a record."""
        if self._actuators:
            return self._actuators.model_states(inputs)
        return self.mechanics.model_states(*self._truth(states, inputs))

    def with_parameters(self, values: Array) -> Rig:
        """The rig with other values (k,) of its parameters."""
        other, count = copy(self), len(self.mechanics.parameters)
        if count:
            other.mechanics = self.mechanics.with_parameters(values[:count])
        other._values = dict(zip(self._values, values[count:].tolist(), strict=True))
        other._assemble()
        return other

    @property
    def slack(self) -> Array:
        """The slack of the mechanics."""
        return self.mechanics.slack

    def without_dry_friction(self) -> Rig:
        """The rig without dry friction in motors and mechanics."""
        other = copy(self)
        other.mechanics = self.mechanics.without_dry_friction()
        dry = [name for name in self._values if name.endswith((".stribeck", ".load"))]
        other._values = self._values | dict.fromkeys(dry, 0.0)
        other._assemble()
        return other

    def _truth(self, y: Array, acting: Array) -> tuple[Array, Array]:
        """True states (..., n) behind a record, and the inputs (..., m) acting on the mechanics."""
        n = len(self._states)
        x = elementwise(_away(n), y, parameters=self._numbers)
        return x, elementwise(_braked(n, self._brakes), x, acting, parameters=self._numbers)

    def _record(self, x: Array) -> Array:
        """The record (..., n) of states."""
        return elementwise(_back(len(self._states)), x, parameters=self._numbers)


def check_signals(task: Task, motors: Mapping[str, Motor], sensors: Mapping[str, Sensor]) -> None:
    """Refuse motors and sensors that the task does not have, or that are declared inconsistently.

    Raises
    ------
    ValueError
        If the task has no such input or state, a motor has friction but no velocity, or a delay is too long.
    """
    states = _names(task.states)
    _check_names(motors, _names(task.inputs), "motors")
    _check_names(sensors, states, "sensors")
    _check_names([motor.velocity for motor in motors.values() if motor.velocity], states, "motors")
    for name, motor in motors.items():
        if (motor.stribeck or motor.load) and motor.velocity is None:
            raise ValueError(f"motors.{name}.velocity: missing; stribeck and load need it")
    _taps(task, motors)


def _names(signals: Sequence[Quantity | Parameter]) -> list[str]:
    return [each.name for each in signals]


def _check_names(named: Sequence[str] | Mapping[str, object], known: Sequence[str], key: str) -> None:
    unknown = sorted(set(named) - set(known))
    if unknown:
        raise ValueError(f"{key}: no {', '.join(unknown)}; available: {', '.join(known)}")


def _taps(task: Task, motors: Mapping[str, Motor]) -> int:
    """The number of earlier inputs that the longest delay needs."""
    longest = max((motor.delay for motor in motors.values()), default=0.0)
    return taps_of(MOST_DELAY * longest, task.time_step)


def _parameters(
    signals: Sequence[Quantity], uncertain: Mapping[str, Motor | Sensor], states: Sequence[Quantity] = ()
) -> list[Parameter]:
    """The uncertain parameters of motors or of sensors, signal by signal; motors brake these states."""
    return [
        Parameter(
            f"{signal.name}.{name}",
            unit or signal.unit,
            value,
            spread,
            prior,
            name == "zero",
            _assumed(uncertain[signal.name], states) if name in ("stribeck", "load") else "",
        )
        for signal in signals
        if signal.name in uncertain
        for name, (unit, value, prior) in _PRIORS.items()
        if (spread := getattr(uncertain[signal.name], name, 0.0))  # each has some of these
    ]


def _assumed(motor: Motor | Sensor, states: Sequence[Quantity]) -> str:
    """The velocity that a motor's Stribeck friction is identified at; "" without such friction."""
    if not isinstance(motor, Motor) or not motor.stribeck:
        return ""
    unit = next(state.unit for state in states if state.name == motor.velocity)
    return f"Stribeck velocity of {STRIBECK:g} {unit}"


def _function(name: str, arguments: str, terms: Sequence[str]) -> Callable:
    """A function that returns the tuple of these terms."""
    return function_of(f"def {name}({arguments}): return ({', '.join(terms)},)", name)


def _away(n: int) -> Callable:
    """Kernel: states from a record y (n,); parameters are offsets (n,), then gains (n,)."""
    return _function("away", "y, p", [f"(y[{i}] - p[{i}]) / p[{n + i}]" for i in range(n)])


def _back(n: int) -> Callable:
    """Kernel: the record from states x (n,)."""
    return _function("back", "x, p", [f"x[{i}] * p[{n + i}] + p[{i}]" for i in range(n)])


def _braked(n: int, brakes: Sequence[int | None]) -> Callable:
    """Kernel: the acting input (m,), which is u (m,) minus friction at the velocities of these states."""
    m, terms = len(brakes), []
    for j, i in enumerate(brakes):
        if i is None:
            terms.append(f"u[{j}]")
            continue
        ratio = f"(x[{i}] * {1 / STRIBECK})"
        size = f"(p[{2 * n + j}] / (1.0 + {ratio} * {ratio}) + p[{2 * n + m + j}] * abs(u[{j}]))"
        terms.append(f"u[{j}] - {size} * x[{i}] * (x[{i}] * x[{i}] + {SMOOTH**2}) ** -0.5")
    return _function("braked", "x, u, p", terms)


@lru_cache(maxsize=64)
def _recorded(step: Callable, n: int, brakes: tuple[int | None, ...], remembers: bool) -> Callable:
    """The kernel that steps a record of the mechanics, whose parameters follow the rig's."""
    away, back, braked = _away(n), _back(n), _braked(n, brakes)
    count = 2 * n + 2 * len(brakes)

    def recorded(y, u, parameters):
        x = away(y, parameters)
        return back(step(x, braked(x, u, parameters), parameters[count:]), parameters)

    def recorded_with_memory(y, u, parameters, memory):
        x = away(y, parameters)
        x_next, kept = step(x, braked(x, u, parameters), parameters[count:], memory)
        return back(x_next, parameters), kept

    return recorded_with_memory if remembers else recorded
