"""Predict a policy's cost as the paper does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.core import Cost, Evaluation, Model, Objective, Task
from simbias.core.records import Array
from simbias.simulation.closed_loop import Scenarios, join, simulator


@dataclass(eq=False)
class CostOfOneRollout(Objective):
    """Z (Eq. 8) of a policy's rollout from one start."""

    simulator: Scenarios
    cost: Cost
    start: Array  # (n,)
    steps: int = 0  # simulated so far

    def together(self, thetas: Array) -> Array:
        """Z (k,) of thetas (k, p)."""
        k = len(thetas)
        starts, scenarios = np.tile(self.start, (k, 1)), np.zeros(k, np.int64)
        costs, frames = self.simulator.costs(self.cost, thetas, starts, scenarios)
        self.steps += int(frames.sum())
        return costs


class NominalStart(Evaluation):
    """The cost of one rollout from the task's mean start, without noise (Section V)."""

    def __init__(self, task: Task) -> None:
        self._start = task.start_mean

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """Z (Eq. 8) of a policy's rollout in simulation."""
        return CostOfOneRollout(join([simulator(model)]), cost, self._start)
