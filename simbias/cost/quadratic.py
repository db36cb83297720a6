"""The cost of a rollout (Eq. 8)."""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from simbias.interfaces import Cost, Task
from simbias.records import Rollout
from simbias.simulation.kernels import COST, kernel


@kernel(COST)
def _peak_and_effort(states, inputs, lost, weights):
    """Eq. 8 with diagonal R and Q; weights are c, the diagonal of R, the diagonal of Q."""
    n, m = states.shape[1], inputs.shape[1]
    peak = 0.0
    for t in range(1, states.shape[0]):
        distance = 0.0
        for i in range(n):
            distance += weights[1 + i] * states[t, i] ** 2
        peak = max(peak, distance)
    effort = 0.0
    for t in range(inputs.shape[0]):
        for i in range(m):
            effort += weights[1 + n + i] * inputs[t, i] ** 2
    return weights[0] * lost + peak + effort


class Quadratic(Cost):
    """Z = c (T - t_fail) + max x^T R x + sum u^T Q u (Eq. 8), R and Q diagonal."""

    def __init__(
        self,
        task: Task,
        failure_weight: PositiveFloat,
        state_weights: list[NonNegativeFloat],
        input_weights: list[NonNegativeFloat],
        max_cost: PositiveFloat,
    ) -> None:
        for name, weights, quantities in (
            ("state_weights", state_weights, task.states),
            ("input_weights", input_weights, task.inputs),
        ):
            if len(weights) != len(quantities):
                raise ValueError(f"{name} has {len(weights)} values; the task has {len(quantities)}")
        self.max_cost = max_cost
        self._horizon = task.horizon
        self._weights = np.array([failure_weight, *state_weights, *input_weights])

    def of(self, rollout: Rollout) -> float:
        """Z of a rollout (Eq. 8)."""
        lost = 0 if rollout.failed_at is None else self._horizon - rollout.failed_at
        return _peak_and_effort(rollout.states, rollout.inputs, lost, self._weights)
