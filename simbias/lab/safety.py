"""Limits at which an experiment is aborted: held at each frame where simbias runs the loop, else ordered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Controller, Law, Policy, Quantity, Task
from simbias.core.ranges import Positive
from simbias.core.records import Array, Rollout


@dataclass(frozen=True)
class Safety:
    """Limits by the names of the task's quantities, or their kinds; the task's own hold besides.

    Parameters
    ----------
    inputs
        Largest size of an input.
    input_rates
        Largest change of an input in a second, from one frame to the next.
    states
        Largest size of a (measured) state.
    criteria
        Whether a (measured) state that violates a failure criterion aborts too.
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
        """The limits as arrays.

        Raises
        ------
        ValueError
            If a limit names nothing of the task.
        """
        inputs = _by_quantity("inputs", self.inputs, task.inputs)
        return Bounds(
            np.fmin(inputs, task.input_limit),
            _by_quantity("input_rates", self.input_rates, task.inputs),
            _by_quantity("states", self.states, task.states),
            self.criteria,
        )


NO_LIMITS = Safety()


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits as arrays; inf where there is none."""

    inputs: Array  # (m,)
    input_rates: Array  # (m,) per s
    states: Array  # (n,)
    criteria: bool


def _by_quantity(key: str, limits: Mapping[str, float] | None, quantities: Sequence[Quantity]) -> Array:
    """The limit of each quantity, by its name or its kind."""
    limits = limits or {}
    known = {name for quantity in quantities for name in quantity.names}
    unknown = sorted(set(limits) - known)
    if unknown:
        raise ValueError(f"{key} names no quantity of the task: {', '.join(unknown)}; it has {sorted(known)}")
    return np.array(
        [next((limits[name] for name in quantity.names if name in limits), np.inf) for quantity in quantities]
    )


class UnsafeError(Exception):
    """A limit is exceeded: the experiment ends here, with what was recorded so far."""


class Guarded(Policy):
    """A policy whose controller refuses to go on beyond limits.

    It holds them for hardware that runs its loop by `controller`; what calls `act` holds none.
    """

    def __init__(self, policy: Policy, task: Task, bounds: Bounds) -> None:
        self.policy = policy
        self.bounds_of_safety = bounds
        self._task = task
        self.n_parameters, self.bounds = policy.n_parameters, policy.bounds
        self.memory_size, self.kernel = policy.memory_size, policy.kernel
        self.last: _GuardedController | None = None  # controller, which knows what has been recorded

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        """As the policy does."""
        return self.policy.act(theta, x, t, memory)

    def outputs(self, x: Array) -> Array:
        """As the policy does."""
        return self.policy.outputs(x)

    def law(self, theta: Array) -> Law:
        """As the policy does."""
        return self.policy.law(theta)

    def __getattr__(self, name: str) -> Any:
        """What else the policy has."""
        if name.startswith("__") or "policy" not in vars(self):  # while it is copied
            raise AttributeError(name)
        return getattr(self.policy, name)

    def controller(self, theta: Array, time_step: float) -> Controller:
        """The policy's controller, watched."""
        inner = self.policy.controller(theta, time_step)
        self.last = _GuardedController(inner, self._task, self.bounds_of_safety, time_step)
        return self.last


class _GuardedController(Controller):
    """A controller that raises before it gives an input beyond the limits, and whenever it is asked again."""

    def __init__(self, controller: Controller, task: Task, bounds: Bounds, time_step: float) -> None:
        self._controller = controller
        self._task = task
        self._bounds = bounds
        self._largest_change = bounds.input_rates * time_step
        self._states: list[Array] = []
        self._inputs: list[Array] = []
        self.failure = ""  # what ended the experiment

    def __call__(self, x: Array) -> Array:
        """Input u (m,) at the (measured) state x (n,) of the next frame.

        Raises
        ------
        UnsafeError
            If state or input is beyond its limits.
        """
        if not self.failure:
            self._states.append(np.array(x, dtype=np.float64))
            self.failure = self._of_state(x)
        if not self.failure:
            u = self._controller(x)
            self.failure = self._of_input(u)
            if not self.failure:
                self._inputs.append(np.array(u, dtype=np.float64))
                return u
        raise UnsafeError(self.failure)

    def record(self) -> Rollout:
        """What the controller saw and gave, up to the frame that was unsafe."""
        k = len(self._inputs)
        states = np.array(self._states)[: k + 1]
        inputs = np.array(self._inputs).reshape(k, len(self._task.inputs))
        return Rollout(states, inputs, k, self.failure, measured=states, sensed=True)

    def _of_state(self, x: Array) -> str:
        """What is unsafe about a state; "" if nothing."""
        beyond = np.flatnonzero(~(np.abs(x) <= self._bounds.states))
        if len(beyond):
            return f"unsafe_state_{self._task.states[beyond[0]].name}"
        return (self._task.failure(x) or "") if self._bounds.criteria else ""

    def _of_input(self, u: Array) -> str:
        """What is unsafe about an input; "" if nothing."""
        beyond = np.flatnonzero(~(np.abs(u) <= self._bounds.inputs * (1 + 1e-12)))
        if len(beyond):
            return f"unsafe_input_{self._task.inputs[beyond[0]].name}"
        if self._inputs:
            change = np.abs(u - self._inputs[-1])
            beyond = np.flatnonzero(~(change <= self._largest_change * (1 + 1e-12)))
            if len(beyond):
                return f"unsafe_rate_of_{self._task.inputs[beyond[0]].name}"
        return ""
