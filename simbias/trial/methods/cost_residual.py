"""A residual of the cost instead of the state: how much more a policy costs than predicted."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import numpy as np

from simbias.core.objective import Mapped
from simbias.core.ranges import Count, Scale
from simbias.core.records import Array, Iteration, Search, Transitions
from simbias.learning.bias.posterior import GPPosterior, exact
from simbias.learning.covariance import Hyperparameters
from simbias.search.lqr import lqr_candidates
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, log_costs
from simbias.trial.study import Study

NOISE = 0.01  # variance of ln Z between starts, relative to that of the residual


@dataclass(eq=False)
class CostResidual(Method):
    """Minimise ln Z in simulation plus a learned residual of ln Z.

    The residual, ln Z_r - ln Z_g of each policy tried, is a Gaussian process over the policy's parameters, as
    in Bayesian optimisation with a simulation as prior (Cully et al., Nature 521, 2015). Its lower confidence
    bound is added, which favours exploration. The model itself does not change.

    Parameters
    ----------
    max_iterations
        The maximum number of policies tried.
    experiments
        Hardware experiments per iteration; the first failure ends them.
    length_scale
        Length scale of the Gaussian process, relative to the width of the parameters' box.
    lqr_candidates
        Number of models whose LQR policies a search evaluates first.
    """

    max_iterations: Count = 10
    experiments: Count = 2
    length_scale: Scale = 0.05
    lqr_candidates: Count = 1

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration."""
        scenario_rng, search_rng, hardware_rng = rng.spawn(3)
        model, made = study.first_model(), 0
        lower, upper = study.policy.bounds
        hyper = Hyperparameters(upper - lower, np.full(len(lower), self.length_scale), 1.0, NOISE, 0.0)
        tried, residuals = np.empty((0, len(lower))), np.empty((0, 1))
        for index in range(self.max_iterations):
            clock = Stopwatch()
            with clock("search"):  # the same scenarios each time, as a replayed search draws none
                predicted = study.evaluation.objective(model, study.cost, deepcopy(scenario_rng))
                residual = exact(hyper, Transitions(tried, residuals))
                cost = Mapped(predicted, partial(_corrected, residual))
                candidates = lqr_candidates(model, self.lqr_candidates)
                (own_rng,) = search_rng.spawn(1)
                optimum = study.optimizer.minimize(
                    cost, lower, upper, own_rng, study.cost.max_cost, candidates
                )
            found, theta = Search(optimum, optimum.cost), optimum.parameters
            observer.designed(theta, model, found)
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments, 1)
            made += len(rollouts)
            record = iteration_record(study, index, theta, rollouts, made, clock, model, found)
            yield record
            if record.succeeded:
                return
            added = log_costs(record.hardware_cost) - log_costs(predicted(theta))
            tried, residuals = np.vstack([tried, theta]), np.vstack([residuals, [added]])


def _corrected(residual: GPPosterior, thetas: Array, costs: Array) -> Array:
    """Costs (k,) of policies (k, p), corrected by the residual's mean minus one standard deviation."""
    mean, variance = residual.predict(thetas)
    return costs * np.exp(mean[:, 0] - np.sqrt(variance[:, 0]))
