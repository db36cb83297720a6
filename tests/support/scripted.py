"""Searches that predict, and hardware experiments that have, the costs that a test says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from point_mass import PointMass

from simbias.core import Evaluation, Hardware
from simbias.core.records import Iteration, Rollout
from simbias.trial.method import Method
from simbias.trial.study import Study

FRAMES = 25  # of an experiment: five become training data


class ScriptedPrediction(Evaluation):
    """Predicts one cost for every policy of a search."""

    def __init__(self, predicted_costs: Sequence[float]) -> None:
        self._costs = iter(predicted_costs)

    def objective(self, simulator, cost, rng):
        predicted = next(self._costs)
        return lambda theta: predicted


class ScriptedHardware(Hardware):
    """Each experiment has the next cost, by the point mass's mean distance."""

    def __init__(self, costs: Sequence[float]) -> None:
        self._costs = iter(costs)

    def run(self, policy, theta, start, rng):
        states = np.full((FRAMES + 1, 2), next(self._costs))
        return Rollout(states, np.zeros((FRAMES, 1)))


def scripted(
    study: Study, method: Method, predicted: Sequence[float], hardware: Sequence[float]
) -> list[Iteration]:
    """Run a method with the costs that searches predict and experiments have; Z_max is 0.1875."""
    scripts = {"evaluation": ScriptedPrediction(predicted), "hardware": ScriptedHardware(hardware)}
    return list(replace(study, task=PointMass(horizon=FRAMES), **scripts, method=method).run())
