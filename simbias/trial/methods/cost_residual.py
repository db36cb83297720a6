"""A residual on the task's error in place of the state: how much more a policy costs than predicted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from simbias.core import Objective
from simbias.core.ranges import Count, Scale
from simbias.core.records import Array, Iteration, Search, Transitions
from simbias.learning.bias.covariance import Hyperparameters
from simbias.learning.bias.posterior import Posterior, exact
from simbias.search.lqr import LqrCandidates
from simbias.trial.steps import Stopwatch, experiment, iteration_record
from simbias.trial.study import Method, Observer, Study

NOISE = 0.01  # variance of ln Z from start to start, over that of the residual


class CostResidual(Method):
    """Search where ln Z in simulation, and what experiments may add to it, are least together.

    The residual, ln Z_r - ln Z_g of each policy that was tried, is a Gaussian process over the policy's
    parameters, as in Bayesian optimisation with a simulation as prior (Cully et al., Nature 521, 2015). Its
    lower confidence bound is added, so that what is not known is tried. The model stays as it is.

    Parameters
    ----------
    max_iterations
        Policies that are tried.
    experiments
        Hardware experiments of an iteration, which end with the first that fails.
    length_scale
        Of the process, over the width of the parameters' box.
    lqr_candidates
        Models whose LQR policies a search evaluates first.
    """

    def __init__(
        self,
        max_iterations: Count = 10,
        experiments: Count = 2,
        length_scale: Scale = 0.05,
        lqr_candidates: Count = 1,
    ) -> None:
        self.max_iterations = max_iterations
        self.max_experiments = max_iterations * experiments
        self._experiments, self._length_scale = experiments, length_scale
        self._lqr_candidates = lqr_candidates

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration."""
        scenario_rng, search_rng, hardware_rng = rng.spawn(3)
        model, made = study.first_model(), 0
        predicted = study.evaluation.objective(model, study.cost, scenario_rng)
        lower, upper = study.policy.bounds
        hyper = Hyperparameters(upper - lower, np.full(len(lower), self._length_scale), 1.0, NOISE, 0.0)
        tried, residuals = np.empty((0, len(lower))), np.empty((0, 1))
        for index in range(self.max_iterations):
            clock = Stopwatch()
            with clock("search"):
                cost = _Corrected(predicted, exact(hyper, Transitions(tried, residuals)))
                candidates = LqrCandidates(model, self._lqr_candidates)
                (own_rng,) = search_rng.spawn(1)
                optimum = study.optimizer.minimize(
                    cost, lower, upper, own_rng, study.cost.max_cost, candidates
                )
            found, theta = Search(optimum, optimum.cost), optimum.parameters
            observer.designed(theta, model, found)
            with clock("experiments"):
                rollouts = experiment(study, theta, hardware_rng, observer, self._experiments, 1)
            made += len(rollouts)
            succeeded = all(map(study.cost.passes, rollouts))
            record = iteration_record(index, theta, rollouts, succeeded, made, clock, model, found)
            added = np.log(record.hardware_cost) - np.log(predicted(theta))
            tried, residuals = np.vstack([tried, theta]), np.vstack([residuals, [added]])
            yield record
            if succeeded:
                return


class _Corrected:
    """exp(ln Z + residual) of policies, at the residual's lower bound."""

    def __init__(self, predicted: Objective, residual: Posterior) -> None:
        self._predicted, self._residual = predicted, residual
        if hasattr(predicted, "together"):
            self.together = self._together

    @property
    def steps(self) -> int:
        """Simulated so far."""
        return getattr(self._predicted, "steps", 0)

    def __call__(self, theta: Array) -> float:
        return float(self._predicted(theta) * self._factors(theta[None])[0])

    def _together(self, thetas: Array) -> Array:
        return self._predicted.together(thetas) * self._factors(thetas)

    def _factors(self, thetas: Array) -> Array:
        """Factors (k,) by which policies (k, p) cost more than predicted: one deviation below the mean."""
        mean, variance = self._residual.predict(thetas)
        return np.exp(mean[:, 0] - np.sqrt(variance[:, 0]))
