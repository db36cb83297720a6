"""The cost of a rollout (Eq. 8)."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from simbias.core import Cost, Kernel, Quantity, Task
from simbias.core.ranges import NonNegative, Positive
from simbias.core.records import Array, Indices, Rollout


def _peak_and_effort(x, u, weights, totals):
    """The last two terms of Eq. 8 so far, after the step to x under u; R and Q are the weights' diagonals."""
    peak, effort = totals
    distance = 0.0
    for i in range(len(x)):
        distance += weights[i] * (x[i] * x[i])
    for i in range(len(u)):
        effort += weights[len(x) + i] * (u[i] * u[i])
    return max(peak, distance), effort


LARGEST = 1e100  # of a peak: in a frame, a simulated state may grow until its square is no number any more
Weights = list[NonNegative] | dict[str, NonNegative]  # one for each quantity, or by name or kind


class Quadratic(Cost):
    """Z = c (T - t_fail) + max x^T R x + sum u^T Q u (Eq. 8), R and Q diagonal.

    Weights are a list, one for each state or input, or stand by the name or the kind of a quantity; what is
    not named then weighs nothing.
    """

    def __init__(
        self,
        task: Task,
        failure_weight: Positive,
        state_weights: Weights,
        input_weights: Weights,
        max_cost: Positive,
    ) -> None:
        self.max_cost = max_cost
        self._horizon = task.horizon
        self._failure_weight = failure_weight
        self._R = _diagonal("state_weights", state_weights, task.states)  # (n,)
        self._Q = _diagonal("input_weights", input_weights, task.inputs)  # (m,)
        self.kernel: Kernel = Kernel(_peak_and_effort, np.concatenate([self._R, self._Q]))
        self.totals = 2

    def with_horizon(self, horizon: int) -> Quadratic:
        """The cost of rollouts that may take so many frames; an input weighs as much as in the old horizon.

        Otherwise the effort would grow with the horizon, the peak would not, and another policy be the best.
        """
        longer = copy(self)
        longer._horizon, longer._Q = horizon, self._Q * (self._horizon / horizon)
        longer.kernel = Kernel(self.kernel.function, np.concatenate([longer._R, longer._Q]))
        return longer

    def of(self, rollout: Rollout) -> float:
        """Z of a rollout (Eq. 8)."""
        lost = 0 if rollout.failed_at is None else self._horizon - rollout.failed_at
        with np.errstate(over="ignore", invalid="ignore"):
            peak = np.fmax.reduce(np.square(rollout.states[1:]) @ self._R, initial=0.0)  # a state may be nan
        effort = np.sum(np.square(rollout.inputs) @ self._Q)
        return float(self._failure_weight * lost + min(peak, LARGEST) + effort)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (k,) of rollouts whose peaks and efforts are totals (k, 2) and who lost so many frames (k,)."""
        return self._failure_weight * lost + np.minimum(totals, LARGEST).sum(axis=1)


def _diagonal(name: str, weights: Weights, quantities: Sequence[Quantity]) -> Array:
    """The weight of each quantity: by its place, or by its own name or else its kind."""
    if not isinstance(weights, dict):
        if len(weights) != len(quantities):
            raise ValueError(f"{name} has {len(weights)} values; the task has {len(quantities)}")
        return np.array(weights)
    known = dict.fromkeys(name for quantity in quantities for name in quantity.names)
    for key in weights:
        if key not in known:
            raise ValueError(f"{name}: nothing is called {key}; there is {', '.join(known)}")
    own = [[weights[key] for key in quantity.names if key in weights] for quantity in quantities]
    return np.array([values[0] if values else 0.0 for values in own])
