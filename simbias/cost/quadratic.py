"""The cost of a rollout (Eq. 8)."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from simbias.core import Cost, Task
from simbias.core.quantities import Weights, weights_of
from simbias.core.ranges import Positive
from simbias.core.records import Array, Indices

LARGEST = 1e100  # of a peak: within a frame, a simulated state may grow until its square overflows
ROUNDING = 1e-9  # a goal no further from zero, as that of a file, is zero


class Quadratic(Cost):
    """Z = c (T - t_fail) + max x^T R x + sum u^T Q u (Eq. 8), R and Q diagonal.

    Weights are a list with one for each state or input, or a mapping by name or kind of quantities; a
    quantity not named has zero weight.

    Raises
    ------
    ValueError
        If a state with a weight has a goal other than zero, which this cost ignores.
    """

    reductions = ("max", "sum")

    def __init__(
        self,
        task: Task,
        failure_weight: Positive,
        state_weights: Weights,
        input_weights: Weights,
        max_cost: Positive,
    ) -> None:
        self.max_cost = max_cost
        self.horizon, self.time_step = task.horizon, task.time_step
        self._failure_weight = failure_weight
        self._R = weights_of("state_weights", state_weights, task.states)  # (n,)
        self._Q = weights_of("input_weights", input_weights, task.inputs)  # (m,)
        _check_goal(task, self._R)

    def with_horizon(self, horizon: int) -> Self:
        """The cost for another horizon in frames; the total weight of the inputs stays the same.

        Otherwise the effort would grow with the horizon but the peak would not, and another policy would be
        optimal.
        """
        longer = super().with_horizon(horizon)
        longer._Q = self._Q * (self.horizon / horizon)
        return longer

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        """x^T R x and u^T Q u (..., 2) of each frame (Eq. 8)."""
        return np.stack([np.square(x_next) @ self._R, np.square(u) @ self._Q], axis=-1)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (...) of peaks and efforts (..., 2), and the frames (...) lost by failure (Eq. 8)."""
        return self._failure_weight * lost + np.minimum(totals, LARGEST).sum(axis=-1)


def _check_goal(task: Task, weights: Array) -> None:
    """Refuse weights (n,) of states whose goal is not zero, also if it depends on targets."""
    weighted = {state.name for state, weight in zip(task.states, weights, strict=True) if weight}
    times = task.time_step * np.arange(task.horizon + 1)
    elsewhere = np.tile(task.targets_in(task.start_mean) + 1.0, (len(times), 1))
    goal = task.reference(times, elsewhere) if task.targets else task.reference(times)
    goal = np.broadcast_to(goal, (len(times), len(task.goals)))
    for quantity, values in zip(task.goals, goal.T, strict=True):
        if quantity.name in weighted and not (np.abs(values) <= ROUNDING).all():
            raise ValueError(
                f"state_weights: {quantity.name} would be weighted from zero, but its goal is not zero; "
                "cost=tracking weights errors of the goal"
            )
