"""A quadratic cost of the distance from a goal."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from simbias.core import Cost, GoalWeights, Task
from simbias.core.quantities import Weights, weights_of
from simbias.core.ranges import Positive
from simbias.core.records import Array, Indices

LARGEST = 1e100  # of a sum: within a frame, a simulated state may grow until its square overflows


@final
class Tracking(Cost):
    """Z = (c (T - t_fail) + sum of e^T R e + u^T Q u) / T + e_T^T P e_T; R, Q and P are diagonal.

    e is the error of the task's goal.

    Parameters
    ----------
    error_weights, input_weights, final_weights
        The diagonals of R, Q and P: a list, or by name or kind; a quantity not named has zero weight. Rates
        have weights only if they are among the goal's quantities.
    failure_weight
        c, the cost of each frame lost by a failure.
    """

    reductions = ("sum", "sum")

    def __init__(
        self,
        task: Task,
        error_weights: Weights,
        max_cost: Positive,
        failure_weight: Positive,
        input_weights: Weights | None = None,
        final_weights: Weights | None = None,
    ) -> None:
        self.max_cost = max_cost
        self.horizon, self.time_step = task.horizon, task.time_step
        self._task, self._failure_weight = task, failure_weight
        self._R = weights_of("error_weights", error_weights, task.goals)  # (g,)
        self._Q = weights_of("input_weights", input_weights or {}, task.inputs)  # (m,)
        self._P = weights_of("final_weights", final_weights or {}, task.goals)  # (g,)

    @property
    def goal_weights(self) -> GoalWeights:  # type: ignore[override]
        """R and Q per second and P at the end, for Z times the horizon in s."""
        seconds = self.horizon * self.time_step
        return GoalWeights(self._R, self._Q, self.time_step * self._R + seconds * self._P)

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        """The running cost and the final cost (..., 2) of each frame."""
        squares = np.square(self._task.error(x_next, t))
        last = t > (self.horizon - 0.5) * self.time_step
        return np.stack([squares @ self._R + np.square(u) @ self._Q, last * (squares @ self._P)], axis=-1)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (...) of sums (..., 2) and the frames (...) lost by failure."""
        sums = np.minimum(totals, LARGEST)
        return (self._failure_weight * lost + sums[..., 0]) / self.horizon + sums[..., 1]
