"""The cost of a rollout (Eq. 8)."""

from __future__ import annotations

from copy import copy

import numpy as np

from simbias.config.numbers import NonNegative, Positive
from simbias.interfaces import Cost, Kernel, Task
from simbias.records import Array, Indices, Rollout


def _peak_and_effort(x, u, weights, totals):
    """The last two terms of Eq. 8 so far, after the step to x under u; R and Q are the weights' diagonals."""
    peak, effort = totals
    distance = 0.0
    for i in range(len(x)):
        distance += weights[i] * (x[i] * x[i])
    for i in range(len(u)):
        effort += weights[len(x) + i] * (u[i] * u[i])
    return max(peak, distance), effort


class Quadratic(Cost):
    """Z = c (T - t_fail) + max x^T R x + sum u^T Q u (Eq. 8), R and Q diagonal."""

    def __init__(
        self,
        task: Task,
        failure_weight: Positive,
        state_weights: list[NonNegative],
        input_weights: list[NonNegative],
        max_cost: Positive,
    ) -> None:
        for name, weights, quantities in (
            ("state_weights", state_weights, task.states),
            ("input_weights", input_weights, task.inputs),
        ):
            if len(weights) != len(quantities):
                raise ValueError(f"{name} has {len(weights)} values; the task has {len(quantities)}")
        self.max_cost = max_cost
        self._horizon = task.horizon
        self._failure_weight = failure_weight
        self._R, self._Q = np.array(state_weights), np.array(input_weights)  # diagonals (n,), (m,)
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
        peak = np.fmax.reduce(np.square(rollout.states[1:]) @ self._R, initial=0.0)  # a state may be nan
        effort = np.sum(np.square(rollout.inputs) @ self._Q)
        return float(self._failure_weight * lost + peak + effort)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (k,) of rollouts whose peaks and efforts are totals (k, 2) and who lost so many frames (k,)."""
        return self._failure_weight * lost + totals.sum(axis=1)
