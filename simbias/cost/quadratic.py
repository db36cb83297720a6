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


def _and_what_is_left(x, u, weights, totals):
    """Likewise, and the last distance and the sum of all, for costs that ask for them."""
    peak, effort, _, sum_of_distances = totals
    distance = 0.0
    for i in range(len(x)):
        distance += weights[i] * (x[i] * x[i])
    for i in range(len(u)):
        effort += weights[len(x) + i] * (u[i] * u[i])
    return max(peak, distance), effort, distance, sum_of_distances + distance


class Quadratic(Cost):
    """Z = c (T - t_fail) + max x^T R x + sum u^T Q u (Eq. 8), R and Q diagonal.

    Parameters
    ----------
    failure_weight, state_weights, input_weights, max_cost
        c, the diagonals of R and Q, and Z_max.
    final_weight
        Of x^T R x at the end, which the cost has besides.
    mean_weight
        Of the mean of x^T R x over all frames, likewise.
    """

    def __init__(
        self,
        task: Task,
        failure_weight: Positive,
        state_weights: list[NonNegative],
        input_weights: list[NonNegative],
        max_cost: Positive,
        final_weight: NonNegative = 0.0,
        mean_weight: NonNegative = 0.0,
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
        self._final_weight, self._mean_weight = final_weight, mean_weight
        more = final_weight > 0 or mean_weight > 0
        self.totals = 4 if more else 2
        self.kernel = Kernel(
            _and_what_is_left if more else _peak_and_effort, np.concatenate([self._R, self._Q])
        )

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
        distances = np.square(rollout.states[1:]) @ self._R
        peak = np.fmax.reduce(distances, initial=0.0)  # a state may be nan
        effort = np.sum(np.square(rollout.inputs) @ self._Q)
        cost = self._failure_weight * lost + peak + effort
        if self.totals > 2 and len(distances):
            cost += self._final_weight * distances[-1] + self._mean_weight * np.mean(distances)
        return float(cost)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (k,) of rollouts whose peaks and efforts are totals (k, 2) and who lost so many frames (k,)."""
        cost = self._failure_weight * lost + totals[:, :2].sum(axis=1)
        if self.totals > 2:
            frames = np.maximum(self._horizon - lost, 1)
            cost += self._final_weight * totals[:, 2] + self._mean_weight * totals[:, 3] / frames
        return cost
