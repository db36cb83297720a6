"""An upper bound: a search on the hardware itself, as if experiments cost nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simbias.core.ranges import Count
from simbias.core.records import Iteration, Search
from simbias.search.lqr import lqr_policies
from simbias.trial.hardware_cost import check_simulator, cost_on_hardware
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record
from simbias.trial.study import Study


@dataclass(eq=False)
class Ideal(Method):
    """Search on the simulated hardware itself, with its gaps and noise, then experiment once.

    If this policy fails, the policy class or the optimizer is the limit. The search begins with the LQR
    policies of the nominal model.

    Parameters
    ----------
    experiments
        Hardware experiments with the resulting policy.
    rollouts
        Number of starts over which a policy's cost is averaged.
    """

    max_iterations = 1
    experiments: Count = 2
    rollouts: Count = 8

    def check(self, study: Study) -> None:
        """Refuse a hardware that is no simulator."""
        check_simulator(study.hardware)

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield the record of the only iteration; errors as for `check`."""
        scenario_rng, search_rng, hardware_rng = rng.spawn(3)
        clock, model = Stopwatch(), study.first_model()
        with clock("search"):
            cost = cost_on_hardware(study, study.hardware_of(study.task), scenario_rng, self.rollouts)
            box, candidates = study.policy.bounds, lqr_policies(model)
            optimum = study.optimizer.minimize(cost, *box, search_rng, study.cost.max_cost, candidates)
        found, theta = Search(optimum, optimum.cost), optimum.parameters
        observer.designed(theta, model, found)
        with clock("experiments"):
            rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments)
        yield iteration_record(study, 0, theta, rollouts, len(rollouts), clock, model, found)
