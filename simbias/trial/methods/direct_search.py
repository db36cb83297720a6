"""Policy search on the hardware itself, without a model (Fig. 2)."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simbias.core.errors import ConfigError
from simbias.core.extras import library
from simbias.core.model import Model
from simbias.core.ranges import Count, Deviation
from simbias.core.records import Array, Iteration
from simbias.search.lqr import INPUT_WEIGHTS, lqr_policies, why_none
from simbias.search.optimizer.cma import strategy
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record
from simbias.trial.study import Study

Proposals = Generator[Array, float, None]  # policies (p,) to try, each answered by its cost
BOX = 4.0  # half width of Bayesian optimisation's box around a policy, in deviations
FIRST = 2  # random policies per parameter, before Bayesian optimisation has a model


@dataclass(eq=False)
class DirectSearch(Method):
    """Try policies on hardware, each chosen by the costs of the earlier ones.

    Parameters
    ----------
    strategy
        "cma": CMA-ES (N. Hansen's pycma). "bayesian": Bayesian optimisation of ln Z, by its lower
        confidence bound (the library bayesian-optimization).
    begin
        "cold", at the box's centre, or "lqr", at the policy that imitates the nominal model's LQR.
    deviation
        Standard deviation of the first generation around this policy, in units of the box's width; Bayesian
        optimisation stays within four deviations.
    max_iterations
        The maximum number of policies tried.
    experiments
        Consecutive passes by which a policy succeeds; the first failure ends its experiments.
    """

    strategy: Literal["cma", "bayesian"] = "cma"
    begin: Literal["cold", "lqr"] = "cold"
    deviation: Deviation = 0.25
    max_iterations: Count = 20
    experiments: Count = 2

    def check(self, study: Study) -> None:
        """If the search begins at the LQR, refuse a policy that cannot imitate it or a model without one."""
        self._start(study, None if self.begin == "cold" else study.model())

    def _start(self, study: Study, model: Model | None) -> Array:
        """The first policy (p,): the one that imitates a model's LQR, or the middle of the bounds."""
        if model is None:
            lower, upper = study.policy.bounds
            return 0.5 * (lower + upper)
        policies = lqr_policies(model, INPUT_WEIGHTS[1:2])
        if not policies:
            raise ConfigError("method.begin", why_none(model, "no LQR"))
        return policies[0]

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every policy that is tried; errors as for `check`."""
        proposal_rng, hardware_rng = rng.spawn(2)
        model = None if self.begin == "cold" else study.first_model()
        start = self._start(study, model)
        proposals = PROPOSALS[self.strategy](*study.policy.bounds, start, self.deviation, proposal_rng)
        made, record = 0, None
        for index in range(self.max_iterations):
            clock = Stopwatch()
            theta = next(proposals) if record is None else proposals.send(record.hardware_cost)
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments, 1)
            made += len(rollouts)
            record = iteration_record(study, index, theta, rollouts, made, clock, model)
            yield record
            if record.succeeded:
                return


def _cma(lower: Array, upper: Array, start: Array, deviation: float, rng: np.random.Generator) -> Proposals:
    """Propose the start, then policies of repeated runs of CMA-ES around it."""
    yield start
    while True:
        evolution = strategy(lower, upper, rng, start, deviation)
        while not evolution.stop():
            points, costs = evolution.ask(), list[float]()
            for point in points:
                costs.append((yield np.clip(lower + (upper - lower) * point, lower, upper)))
            evolution.tell(points, costs)


def _bayesian(
    lower: Array, upper: Array, start: Array, deviation: float, rng: np.random.Generator
) -> Proposals:
    """Propose the start, random policies, then the most promising ones, in a box around the start."""
    optimization = library("bayes_opt", "bayesian-optimization", "study").BayesianOptimization
    reach = BOX * deviation * (upper - lower)
    low, high = np.maximum(lower, start - reach), np.minimum(upper, start + reach)
    names = [f"p{index:03}" for index in range(len(low))]
    box = dict(zip(names, zip(low.tolist(), high.tolist(), strict=True), strict=True))
    seed = int(rng.integers(2**31))
    search = optimization(None, box, random_state=seed, verbose=0, allow_duplicate_points=True)
    theta = start
    for number in range(10**6):
        cost = yield theta
        search.register(dict(zip(names, theta.tolist(), strict=True)), -np.log(max(cost, 1e-6)))
        if number + 1 < FIRST * len(low):
            theta = rng.uniform(low, high)
        else:
            point = search.suggest()
            theta = np.array([point[name] for name in names])


PROPOSALS: dict[str, Callable[[Array, Array, Array, float, np.random.Generator], Proposals]] = {
    "cma": _cma,
    "bayesian": _bayesian,
}
