"""Algorithm 1: Data-efficient reinforcement learning."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simbias.core.ranges import Count
from simbias.core.records import Iteration, Learning, Rollout
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, learn, search
from simbias.trial.study import Study


@dataclass(eq=False)
class Algorithm1(Method):
    """Alternate policy search in simulation with hardware experiments and learning from them.

    After a search that ends above Z_max, the listing applies, not Section V's prose: the model is cleared
    (line 7), and the policy is still tried on hardware (line 9).

    Parameters
    ----------
    max_iterations
        N_out.
    experiments
        Hardware experiments of an iteration.
    """

    max_iterations: Count = 10
    experiments: Count = 2

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration; comments give the listing's lines."""
        search_rng, hardware_rng = rng.spawn(2)
        data, model = study.no_data, study.first_model()  # 1
        experiments: list[Rollout] = []
        learned_from: list[tuple[Rollout, ...]] = []  # the experiments that D comes from
        for i in range(self.max_iterations):  # 2, 3, 15
            clock = Stopwatch()
            with clock("search"):
                found = search(study, model, search_rng, observer)  # 4, 5
            theta, simulation = found.optimum.parameters, model
            reset = found.predicted_cost > study.cost.max_cost  # 6
            if reset:
                data, learned_from = study.no_data, []  # 7
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments)  # 9
            experiments += rollouts
            succeeded = all(map(study.passes, rollouts))  # 10
            with clock("learning"):
                if not succeeded:
                    learned_from.append(rollouts)
                    model, data = learn(study, experiments, learned_from)  # 13, 14
                selection = study.select(rollouts, model.nominal)
            learning = Learning(selection, data, reset)
            made = len(experiments)
            yield iteration_record(study, i, theta, rollouts, made, clock, simulation, found, learning)
            if succeeded:  # 11
                return
