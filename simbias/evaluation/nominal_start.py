"""Predict a policy's cost as the paper does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.interfaces import Cost, Evaluation, Objective, Simulator, Task
from simbias.records import Array
from simbias.simulation.closed_loop import Model


@dataclass(frozen=True, eq=False)
class CostOfOneRollout:
    """Z (Eq. 8) of a policy's rollout from one start."""

    simulator: Simulator
    cost: Cost
    start: Array  # (n,)

    def __call__(self, theta: Array) -> float:
        """Z of theta (p,)."""
        return self.cost.of(self.simulator.rollout(theta, self.start))

    def together(self, thetas: Array) -> Array:
        """Z (k,) of thetas (k, p)."""
        rollouts = self.simulator.rollouts(thetas, np.tile(self.start, (len(thetas), 1)))
        return np.array([self.cost.of(rollout) for rollout in rollouts])


class NominalStart(Evaluation):
    """The cost of one rollout from the task's mean start, without noise (Section V)."""

    def __init__(self, task: Task) -> None:
        self._start = task.start_mean

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """Z (Eq. 8) of a policy's rollout in simulation."""
        return CostOfOneRollout(model.simulator(), cost, self._start)
