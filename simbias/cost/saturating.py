"""A cost of the distance from a goal, which saturates far away."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from simbias.core import Cost, Task
from simbias.core.quantities import Weights, weights_of
from simbias.core.ranges import Positive
from simbias.core.records import Array, Indices

LEAST = 1e-9  # width, in any unit


@final
class Saturating(Cost):
    """Z = (c (T - t_fail) + sum of 1 - exp(-d^2 / 2) + u^T Q u) / T, where d^2 = sum of (e_i / w_i)^2.

    e is the error of the task's goal. Far away the cost is flat (M. P. Deisenroth, D. Fox, C. E. Rasmussen,
    Gaussian Processes for Data-Efficient Learning in Robotics and Control, 2015, Section 3.4).

    Parameters
    ----------
    widths
        w, in units of the goal's quantities: a list, or by name or kind; a quantity not named does not count.
    input_weights
        Q, in the same form, for the inputs.
    failure_weight
        c; the cost of a frame far from the goal is 1.
    """

    reductions = ("sum",)

    def __init__(
        self,
        task: Task,
        widths: Weights,
        max_cost: Positive,
        input_weights: Weights | None = None,
        failure_weight: Positive = 1.0,
    ) -> None:
        self.max_cost = max_cost
        self.horizon, self.time_step = task.horizon, task.time_step
        self._task, self._failure_weight = task, failure_weight
        w = weights_of("widths", widths, task.goals)
        if not w.any():
            raise ValueError("widths: at least one must be above 0")
        if w[w > 0].min() < LEAST:
            raise ValueError(f"widths: those above 0 must be at least {LEAST:g}, got {w[w > 0].min():g}")
        self._W = np.divide(0.5, w**2, out=np.zeros_like(w), where=w > 0)  # (g,)
        self._Q = weights_of("input_weights", input_weights or {}, task.inputs)  # (m,)

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        """The cost (..., 1) of each frame."""
        far = 1.0 - np.exp(-(np.square(self._task.error(x_next, t)) @ self._W))
        return np.stack([far + np.square(u) @ self._Q], axis=-1)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        """Z (...) of sums (..., 1) and the frames (...) lost by failure."""
        return (self._failure_weight * lost + totals[..., 0]) / self.horizon
