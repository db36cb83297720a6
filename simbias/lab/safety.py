"""Limits at which an experiment is aborted: enforced in each frame by simbias's loop, else requested."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simbias.core import Controller, HardwareError, Law, Policy, Quantity, Task
from simbias.core.quantities import by_quantity
from simbias.core.ranges import Positive
from simbias.core.records import Array, Indices, Rollout
from simbias.core.robot import NOT_A_NUMBER

ROUNDING = 1e-12  # relative, for a limit that a controller enforces itself
RECORDED_ROUNDING = 1e-6  # relative, for a limit in data recorded with few digits


@dataclass(frozen=True)
class Safety:
    """Limits by the names or kinds of the task's quantities, in addition to the task's own limits.

    Parameters
    ----------
    inputs
        Largest magnitude of an input.
    input_rates
        Largest change of an input per second, from one frame to the next.
    states
        Largest magnitude of a (measured) state.
    criteria
        Whether a (measured) state that violates a failure criterion also aborts.
    """

    inputs: Mapping[str, Positive] | None = None
    input_rates: Mapping[str, Positive] | None = None
    states: Mapping[str, Positive] | None = None
    criteria: bool = False

    @property
    def limits(self) -> bool:
        """Whether anything is limited."""
        return bool(self.inputs or self.input_rates or self.states or self.criteria)

    def bounds(self, task: Task) -> Bounds:
        """The limits as arrays; targets have none, even if they share a kind with states.

        Raises
        ------
        ValueError
            If a limit names no quantity of the robot.
        """

        def arranged(key: str, values: Mapping[str, float] | None, quantities: Sequence[Quantity]) -> Array:
            return by_quantity(values or {}, quantities, np.inf, f"{key}: nothing is called")

        inputs = arranged("inputs", self.inputs, task.inputs)
        states = arranged("states", self.states, task.without_targets.states)
        return Bounds(
            (np.fmax(-inputs, task.input_bounds[0]), np.fmin(inputs, task.input_bounds[1])),
            arranged("input_rates", self.input_rates, task.inputs),
            np.concatenate([states, np.full(len(task.targets), np.inf)]),
            self.criteria,
        )


NO_LIMITS = Safety()


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits as arrays; inf: no limit."""

    input_bounds: tuple[Array, Array]  # lower, upper (m,)
    input_rates: Array  # (m,) per s
    states: Array  # (n,)
    criteria: bool

    @property
    def inputs(self) -> Array:
        """Largest magnitude (m,) of each input."""
        return np.maximum(*np.abs(self.input_bounds))


class UnsafeError(Exception):
    """A limit is exceeded: the experiment ends here, with the record so far."""


class _Monitor:
    """Names the limit exceeded by a state or by the next input; "" for none."""

    def __init__(self, task: Task, bounds: Bounds, time_step: float, rounding: float = ROUNDING) -> None:
        self._task = task
        self._states = np.fmin(bounds.states, np.finfo(np.float64).max)  # so that inf exceeds every limit
        self._criteria = bounds.criteria
        rounded = rounding * np.where(np.isfinite(bounds.inputs), bounds.inputs, 0.0)
        self._least, self._most = bounds.input_bounds[0] - rounded, bounds.input_bounds[1] + rounded
        self._changes = bounds.input_rates * time_step * (1 + rounding)
        self._last: Array | None = None  # input (m,)

    def of_state(self, x: Array) -> str:
        """The limit that the state x (n,) exceeds."""
        beyond = np.flatnonzero(~(np.abs(x) <= self._states))
        if len(beyond):
            return f"unsafe_state_{self._task.states[beyond[0]].name}"
        return (self._task.failure(x) or "") if self._criteria else ""

    def of_input(self, u: Array) -> str:
        """The limit that the input u (m,) of the next frame exceeds."""
        beyond = np.flatnonzero(~((self._least <= u) & (u <= self._most)))
        if len(beyond):
            return f"unsafe_input_{self._task.inputs[beyond[0]].name}"
        if self._last is not None:
            beyond = np.flatnonzero(~(np.abs(u - self._last) <= self._changes))
            if len(beyond):
                return f"unsafe_rate_of_{self._task.inputs[beyond[0]].name}"
        self._last = np.array(u, dtype=np.float64)
        return ""

    def beyond(self, x: Array, u: Array) -> Indices:
        """The frames whose states x (k, n) or inputs u (k, m) exceed a limit."""
        changes = np.abs(np.diff(u, axis=0, prepend=u[:1]))
        within = (np.abs(x) <= self._states).all(axis=1) & (changes <= self._changes).all(axis=1)
        within &= ((self._least <= u) & (u <= self._most)).all(axis=1)
        if self._criteria:
            within &= self._task.violated(x) < 0
        return np.flatnonzero(~within)


def hold(rollout: Rollout, task: Task, bounds: Bounds, source: str) -> Rollout:
    """Cut a rollout at the first state beyond its limits, as if the experiment had been aborted there.

    Raises
    ------
    HardwareError
        If an input was beyond its limits, so they were not enforced.
    """
    monitor = _Monitor(task, bounds, task.time_step, RECORDED_ROUNDING)
    seen = rollout.states if rollout.measured is None else rollout.measured
    beyond = monitor.beyond(seen[: rollout.frames], rollout.inputs)
    if not len(beyond):
        return rollout
    frame = int(beyond[0])
    if failure := monitor.of_state(seen[frame]):
        return replace(rollout.part(0, frame), failed_at=frame, failure=failure)
    inputs = rollout.inputs[max(frame - 1, 0) : frame + 1]
    *_, failure = map(monitor.of_input, inputs)
    raise HardwareError(
        f"{source}: inputs: expected them within the limits of the task and of hardware.safety, "
        f"got {failure} in frame {frame}: {inputs.tolist()}"
    )


def exceeded(rollout: Rollout, task: Task, bounds: Bounds) -> str:
    """The limits, except failure criteria, exceeded by a rollout, and its values; "" for none."""
    rates = np.abs(np.diff(rollout.inputs, axis=0)) / task.time_step
    found = []
    for words, quantities, values, limits in (
        ("|{}| of {:.3g} {}", task.states, np.abs(rollout.states[:-1]), bounds.states),
        ("|{}| of {:.3g} {}", task.inputs, np.abs(rollout.inputs), bounds.inputs),
        ("a change of {} by {:.3g} {} per s", task.inputs, rates, bounds.input_rates),
    ):
        for quantity, largest, limit in zip(quantities, values.max(axis=0, initial=0.0), limits, strict=True):
            if largest > limit * (1 + RECORDED_ROUNDING):
                found.append(f"{words.format(quantity.name, largest, quantity.unit)} (limit {limit:g})")
    return ", ".join(found)


class SafetyLimitedPolicy(Policy):
    """A policy whose controller raises UnsafeError at a frame beyond the limits.

    It enforces the limits if hardware uses `controller`, but not if it calls `act`.
    """

    def __init__(self, policy: Policy, task: Task, safety_bounds: Bounds) -> None:
        self.policy = policy
        self.safety_bounds = safety_bounds
        self._task = task
        self.n_parameters, self.bounds = policy.n_parameters, policy.bounds
        self.state_size = policy.state_size
        self._last: _SafetyLimitedController | None = None

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs and state of the policy, without limits."""
        return self.policy.act(theta, x, t, policy_state)

    def act_within_criteria(
        self, theta: Array, x: Array, t: float, policy_state: Array
    ) -> tuple[Array, Array]:
        """Inputs and state of the policy; beyond a failure criterion nan, which violates any limit."""
        u, policy_state = self.policy.act(theta, x, t, policy_state)
        limits = np.array([criterion.limit for criterion in self._task.criteria])
        beyond = np.where(self._task.measure(x) <= limits, 0.0, np.nan)
        return u + beyond.sum(axis=-1, keepdims=True), policy_state

    def law(self, theta: Array) -> Law:
        """The policy's law."""
        return self.policy.law(theta)

    def __getattr__(self, name: str) -> Any:
        """Attributes of the underlying policy."""
        if name.startswith("__") or "policy" not in vars(self):  # during copying
            raise AttributeError(name)
        return getattr(self.policy, name)

    def controller(self, theta: Array, time_step: float) -> Controller:
        """The policy's controller, within the limits."""
        inner = self.policy.controller(theta, time_step)
        self._last = _SafetyLimitedController(inner, self._task, self.safety_bounds, time_step)
        return self._last

    @property
    def aborted(self) -> Rollout | None:
        """The recording of the last controller, if it aborted its experiment."""
        return self._last.record() if self._last and self._last.failure else None


def without_limits(policy: Policy) -> Policy:
    """The underlying policy, without safety limits."""
    return policy.policy if isinstance(policy, SafetyLimitedPolicy) else policy


def within_limits(policy: Policy, task: Task, name: str) -> Policy:
    """A copy of a policy, called `name` in errors, whose controller raises one beyond the task's limits."""

    def controller(theta: Array, time_step: float) -> Controller:
        return _ControllerWithinLimits(policy.controller(theta, time_step), task, name)

    limited = copy(policy)
    limited.controller = controller  # type: ignore[method-assign]
    return limited


class _ControllerWithinLimits(Controller):
    """A controller that raises instead of returning an input beyond the task's limits."""

    def __init__(self, controller: Controller, task: Task, name: str) -> None:
        self._controller, self._bounds, self._name = controller, task.input_bounds, name

    def __call__(self, x: Array) -> Array:
        """Input u (m,) at the state x (n,) of the next frame; HardwareError if it is beyond the limits."""
        u, (lower, upper) = self._controller(x), self._bounds
        tolerance = RECORDED_ROUNDING * np.maximum(np.abs(lower), np.abs(upper))  # single precision
        if ((u < lower - tolerance) | (u > upper + tolerance)).any():
            limits = f"within {lower} and {upper}"
            raise HardwareError(f"{self._name}.act: expected inputs {limits}, got {np.asarray(u)}")
        return u

    @property
    def policy_state(self) -> Array:  # type: ignore[override]
        """The policy state (s,) of the next frame."""
        return self._controller.policy_state


class _SafetyLimitedController(Controller):
    """A controller that raises instead of returning an input beyond the limits, and at every later call."""

    def __init__(self, controller: Controller, task: Task, bounds: Bounds, time_step: float) -> None:
        self._controller = controller
        self._n, self._m, self._horizon = len(bounds.states), len(task.inputs), task.horizon
        self._monitor = _Monitor(task, bounds, time_step)
        self._states: list[Array] = []
        self._inputs: list[Array] = []
        self.failure = ""  # name of the limit that ended the experiment
        self._misused = False  # whether it was called with anything but a state

    def __call__(self, x: Array) -> Array:
        """Input u (m,) at the (measured) state x (n,) of the next frame.

        Raises
        ------
        UnsafeError
            If state or input exceeds its limits, the policy's own state is not finite, or any of this
            or a ValueError occurred before.
        ValueError
            If the state has another shape, or is not of numbers.
        """
        if self._misused:
            raise UnsafeError(NOT_A_NUMBER)
        if not self.failure:
            self._misused = True  # if the next line raises
            x = np.array(x, dtype=np.float64).reshape(self._n)
            self._misused = False
            if len(self._states) <= self._horizon:  # a controller may run for longer than an experiment
                self._states.append(x)
            self.failure = self._monitor.of_state(x)
        if not self.failure:
            u = self._controller(x)
            self.failure = self._monitor.of_input(u)
            if not (self.failure or np.isfinite(self._controller.policy_state).all()):
                self.failure = NOT_A_NUMBER
            if not self.failure:
                if len(self._inputs) < self._horizon:
                    self._inputs.append(np.array(u, dtype=np.float64))
                return u
        raise UnsafeError(self.failure)

    @property
    def policy_state(self) -> Array:  # type: ignore[override]
        """The policy state (s,) of the next frame."""
        return self._controller.policy_state

    def record(self) -> Rollout:
        """The measured states and the inputs up to the unsafe frame."""
        k = len(self._inputs)
        states = np.array(self._states)[: k + 1]
        inputs = np.array(self._inputs).reshape(k, self._m)
        return Rollout(states, inputs, k, self.failure, measured=states, sensed=True)
