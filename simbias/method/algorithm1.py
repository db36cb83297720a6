"""Algorithm 1: Data-efficient reinforcement learning."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from simbias.interfaces import Method, Observer
from simbias.learning import Stopwatch, experiment, search
from simbias.records import Array, Iteration
from simbias.study import Study


class Algorithm1(Method):
    """Alternate policy search in simulation with hardware experiments and learning from them.

    The listing, not Section V's prose, decides what follows a search that ends above Z_max: the model is
    cleared (line 7), and the policy is still tried on hardware (line 9).

    Parameters
    ----------
    max_iterations
        N_out.
    experiments
        Hardware experiments of an iteration.
    keep_data
        Leave line 7 out: what was learned from hardware outlives a bad search.
    stop_at_failure
        An iteration ends its experiments with the first that fails: the policy is refuted, and the next one
        may teach more.
    retry_search
        How often a search that does not end satisfactorily is made again before hardware is spent on its
        policy.
    satisfactory_cost
        Predicted cost Z below which a search has ended satisfactorily; None is Z_max.
    warm_start
        Evaluate the trial's earlier policies first in a search.
    """

    def __init__(
        self,
        max_iterations: PositiveInt = 10,
        experiments: PositiveInt = 2,
        keep_data: bool = False,
        stop_at_failure: bool = False,
        retry_search: NonNegativeInt = 0,
        satisfactory_cost: PositiveFloat | None = None,
        warm_start: bool = False,
    ) -> None:
        self.max_iterations = max_iterations
        self.experiments = experiments
        self._keep_data = keep_data
        self._stop_at_failure = stop_at_failure
        self._retry_search = retry_search
        self._satisfactory_cost = satisfactory_cost
        self._warm_start = warm_start

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration; comments give the listing's lines."""
        search_rng, hardware_rng = rng.spawn(2)
        max_cost = study.cost.max_cost
        data = study.no_data  # 1
        bias = study.bias.fit(data)
        stop_at = max_cost if self._stop_at_failure else np.inf
        earlier: list[Array] = []
        total_experiments = 0
        for i in range(self.max_iterations):  # 2, 3, 15
            clock = Stopwatch()
            searched_on = bias
            with clock("search"):
                optimum, predicted_cost = search(
                    study, bias, search_rng, observer, earlier, self._retry_search, self._satisfactory_cost
                )  # 4, 5
            theta = optimum.parameters
            if self._warm_start:
                earlier.append(theta)
            reset = predicted_cost > max_cost and not self._keep_data  # 6
            if reset:
                data = study.no_data  # 7
            with clock("experiments"):
                rollouts = experiment(study, theta, hardware_rng, observer, i, self.experiments, stop_at)  # 9
            total_experiments += len(rollouts)
            hardware_cost = max(rollout.cost for rollout in rollouts)
            succeeded = hardware_cost < max_cost  # 10
            with clock("learning"):
                selection = study.samples.select(rollouts, study.nominal)
                if not succeeded:
                    data = data | selection.transitions  # 13
                    bias = study.bias.fit(data)  # 14
            yield Iteration(
                index=i,
                optimum=optimum,
                predicted_cost=predicted_cost,
                model_reset=reset,
                experiments=rollouts,
                hardware_cost=hardware_cost,
                succeeded=succeeded,
                total_experiments=total_experiments,
                selection=selection,
                data=data,
                fitted_bias=searched_on,
                diagnostics=searched_on.diagnostics,
                seconds=clock.seconds,
            )
            if succeeded:  # 11
                return
