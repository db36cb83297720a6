"""One batch of experiments, one fit, one policy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simbias.core.ranges import Count
from simbias.core.records import Iteration, Learning
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, learn, search
from simbias.trial.study import Study


@dataclass(eq=False)
class OneShot(Method):
    """Learn once, from a batch of experiments with the nominal model's policy (Ko et al., ICRA 2007).

    Learning is not iterated: states that the first policy did not visit are not learned.

    Parameters
    ----------
    batch
        Hardware experiments to learn from.
    experiments
        Hardware experiments with the policy found afterwards.
    """

    max_iterations = 2
    batch: Count = 8
    experiments: Count = 2

    def __post_init__(self) -> None:
        self.max_experiments = self.batch + self.experiments

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield the record of the batch, whose full success ends the trial, then that of the new policy."""
        search_rng, hardware_rng = rng.spawn(2)
        data, model, made = study.no_data, study.first_model(), 0
        for index, count in enumerate((self.batch, self.experiments)):
            clock = Stopwatch()
            with clock("search"):
                found = search(study, model, search_rng, observer)
            theta, simulation = found.optimum.parameters, model
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, count)
            made += count
            succeeded = all(map(study.passes, rollouts))
            with clock("learning"):
                selection = study.select(rollouts, model.nominal)
                if not index and not succeeded:
                    model, data = learn(study, rollouts, [rollouts])
            learning = Learning(selection, data)
            yield iteration_record(study, index, theta, rollouts, made, clock, simulation, found, learning)
            if succeeded:
                return
