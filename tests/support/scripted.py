"""Searches and experiments that have the costs that a test says; a method by chance; a listener."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from point_mass import PointMass

from simbias.core import Evaluation, Hardware
from simbias.core.records import Array, Iteration, Rollout
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import experiment
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

    sets_start = False

    def __init__(self, costs: Sequence[float]) -> None:
        self._costs = iter(costs)

    def run(self, policy, theta, start, rng):
        states = np.full((FRAMES + 1, 2), next(self._costs))
        return Rollout(states, np.zeros((FRAMES, 1)))


class Guessing(Method):
    """Two iterations of two experiments, with policies by chance; its numbers are NumPy's."""

    max_iterations = 2
    max_experiments = 4
    counts_from = 0
    shares_its_generator = False
    draws_starts_anew = False
    breaks = False
    succeeds = False

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        for index in range(2):
            if self.shares_its_generator:
                theta = 0.1 * rng.standard_normal(study.policy.n_parameters)
                made = tuple(study.experiment(theta, rng) for _ in range(2))
                for each in made:
                    observer.experimented(each)
            else:
                theta_rng, experiment_rng = rng.spawn(2)
                experiment_rng = np.random.default_rng() if self.draws_starts_anew else experiment_rng
                theta = 0.1 * theta_rng.standard_normal(study.policy.n_parameters)
                made = experiment(study, None, theta, experiment_rng, observer, 2)
            if self.breaks:
                raise ZeroDivisionError("of nothing")
            cost = np.max([rollout.cost for rollout in made])
            succeeded = np.bool_(self.succeeds and index == 1)
            count = np.int64(self.counts_from + 2 * (index + 1))
            yield Iteration(index, theta, made, cost, succeeded, count)  # type: ignore[arg-type]


class Listener(Observer):
    """Notes what it hears, and of what."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, Any]] = []

    def searching(self, evaluations: int, best_cost: float) -> None:
        self.heard.append(("searching", evaluations))

    def experimenting(self, theta: Array, start: Array) -> None:
        self.heard.append(("experimenting", (theta, start)))

    def experimented(self, rollout: Rollout) -> None:
        self.heard.append(("experimented", rollout))

    def iterated(self, iteration: Iteration) -> None:
        self.heard.append(("iterated", iteration.index))


def scripted(
    study: Study, method: Method, predicted: Sequence[float], hardware: Sequence[float]
) -> list[Iteration]:
    """Run a method with the costs that searches predict and experiments have; Z_max is 0.1875."""
    scripts = {"evaluation": ScriptedPrediction(predicted), "hardware": ScriptedHardware(hardware)}
    return list(replace(study, task=PointMass(horizon=FRAMES), **scripts, method=method).run())
