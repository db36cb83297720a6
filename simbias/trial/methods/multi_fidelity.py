"""Policy search on simulators of increasing fidelity, then on the hardware."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Hardware
from simbias.core.ranges import Count
from simbias.core.records import Iteration, Learning, Rollout, Search
from simbias.trial.hardware_cost import check_simulator, cost_on_hardware
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, learn, search
from simbias.trial.study import Study


@dataclass(eq=False)
class MultiFidelity(Method):
    """Search on the nominal model, continue on a better simulator, and end on the hardware.

    After Cutler, Walsh and How (IEEE T-RO 31, 2015): cheap simulators are exhausted before expensive ones are
    used, results of the expensive ones correct the cheapest, and the search never returns to a refuted level.
    They treat discrete actions; here each level is a policy search that begins at the last level's optimum.
    Without a simulator in the middle, the levels are the model and the hardware.

    Parameters
    ----------
    hardware_from
        Constructs the intermediate simulator for a task.
    middle
        Its config, an option of the group `hardware`; None: no intermediate simulator.
    rollouts
        Number of starts on it over which a policy's cost is averaged.
    max_iterations
        The maximum number of policies tried on the hardware.
    experiments
        Hardware experiments per iteration; the first failure ends them.
    lqr_candidates
        Number of models whose LQR policies a search on the model evaluates first.
    """

    hardware_from: Callable[[Mapping[str, Any]], Hardware]
    middle: dict[str, Any] | None = None
    rollouts: Count = 4
    max_iterations: Count = 10
    experiments: Count = 2
    lqr_candidates: Count = 1

    def __post_init__(self) -> None:
        self._middle = None if self.middle is None else self.hardware_from(self.middle)

    def check(self, study: Study) -> None:
        """Refuse an intermediate level that is not a simulator."""
        if self._middle is not None:
            check_simulator(self._middle, "method.middle")

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration, each of which ends on the hardware."""
        search_rng, middle_rng, hardware_rng = rng.spawn(3)
        data, model, middle = study.no_data, study.first_model(), self._middle
        experiments: list[Rollout] = []
        learned_from: list[tuple[Rollout, ...]] = []
        for index in range(self.max_iterations):
            clock = Stopwatch()
            with clock("search"):
                found = search(study, model, search_rng, observer, lqr_candidates=self.lqr_candidates)
                theta, simulation = found.optimum.parameters, model
                if middle is not None:
                    scenario_rng, own_rng = middle_rng.spawn(2)
                    cost = cost_on_hardware(study, middle, scenario_rng, self.rollouts)
                    box, target = study.policy.bounds, study.cost.max_cost
                    optimum = study.optimizer.minimize(cost, *box, own_rng, target, [theta])
                    found, theta = Search(optimum, optimum.cost), optimum.parameters
                    observer.designed(theta, model, found)
                    middle = None  # this level is exhausted
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments, 1)
            experiments += rollouts
            succeeded = all(map(study.passes, rollouts))
            with clock("learning"):
                if not succeeded:
                    learned_from.append(rollouts)
                    model, data = learn(study, experiments, learned_from)
                selection = study.select(rollouts, model.nominal)
            made, learning = len(experiments), Learning(selection, data)
            yield iteration_record(study, index, theta, rollouts, made, clock, simulation, found, learning)
            if succeeded:
                return
