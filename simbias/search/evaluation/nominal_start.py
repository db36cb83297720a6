"""Predict a policy's cost as in the paper."""

from __future__ import annotations

import numpy as np

from simbias.core import Cost, Evaluation, Model, Objective, Task
from simbias.search.evaluation.scenarios import CostOfScenarios, Scenario
from simbias.simulation.closed_loop import simulator


class NominalStart(Evaluation):
    """The cost of one rollout from the task's mean start, without noise (Section V)."""

    def __init__(self, task: Task) -> None:
        self._start = task.start_mean

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """Z (Eq. 8) of a policy's rollout in simulation."""
        return CostOfScenarios([Scenario(simulator(model), self._start)], cost)
