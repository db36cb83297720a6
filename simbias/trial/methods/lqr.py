"""Linear-quadratic regulation, without any search."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simbias.core.errors import ConfigError
from simbias.core.model import Model
from simbias.core.ranges import Count, NonNegative, Scale
from simbias.core.records import Array, Iteration, Rollout
from simbias.search.lqr import INPUT_WEIGHTS, lqr_policies, why_none
from simbias.trial.claim import Confidence, check_passes, passes_for
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record
from simbias.trial.study import Study


@dataclass(eq=False)
class Lqr(Method):
    """Try the policy that imitates the LQR of the nominal model; if asked for, of the identified one then.

    The model is linearised by differences over 0.1 of each state's unit and of each input's limit, so that
    friction, which is steep near rest, is not mistaken for damping. So gains differ from those of exact
    derivatives: by up to 7% for the paper's robot, by 1% at most for the cart-poles.

    Parameters
    ----------
    input_weight
        Weight of the squared inputs at their limits, that of the squared deviation of a state by one unit
        being 1: smaller ones give quicker regulators.
    experiments
        Hardware experiments of an iteration.
    passes
        Experiments that a policy has to pass to succeed, at least `experiments`, which is what None means;
        those beyond are made only as long as all are passed.
    identified
        A failure is learned from: the nominal model's parameters are identified from all experiments, and the
        policy is designed again.
    integral_weight
        Weight of the squared integrals over time of what the policy integrates, which makes it LQI: a steady
        disturbance leaves no error. 0: no integral.
    max_iterations
        Designs, with identification; without, there is one.
    sticking
        Dry friction is taken for the damping that it looks like at rest (`simbias.search.lqr`).
    confidence
        Share of starts that a trial has to know that its policy holds: success takes as many passes as bound
        it by that (`simbias.trial.claim`), regardless of `passes`. None: it does not ask.
    """

    input_weight: Scale = INPUT_WEIGHTS[1]
    experiments: Count = 2
    passes: Count | None = None
    identified: bool = False
    max_iterations: Count = 10
    integral_weight: NonNegative = 0.0
    sticking: bool = True
    confidence: Confidence | None = None

    def __post_init__(self) -> None:
        check_passes(self.passes, self.experiments)
        if not self.identified:
            self.max_iterations = 1

    def passes_of(self, policy: int) -> int:
        """Experiments that the policy of this number has to pass."""
        return passes_for(self.confidence, policy, self.experiments, self.passes)

    def check(self, study: Study) -> None:
        """Refuse a policy that imitates no such regulator, and a model that has none."""
        self._design(study.model())

    def _design(self, model: Model) -> Array:
        """The policy (p,) that imitates the model's regulator."""
        policies = lqr_policies(model, (self.input_weight,), self.integral_weight, sticking=self.sticking)
        if not policies:
            integral = self.integral_weight > 0
            raise ConfigError("method", why_none(model, "no LQI" if integral else "no LQR", integral))
        (theta,) = policies
        return theta

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration; errors as of `check`."""
        model, experiments = study.first_model(), list[Rollout]()
        for index in range(self.max_iterations):
            clock = Stopwatch()
            with clock("learning"):
                if experiments:
                    model = study.model(None, study.identified(experiments))
            with clock("design"):
                theta = self._design(model)
            observer.designed(theta, model)
            with clock("experiments"):
                passes = self.passes_of(index)
                rollouts = experiment(study, model, theta, rng, observer, passes, self.experiments)
            experiments += rollouts
            record = iteration_record(study, index, theta, rollouts, len(experiments), clock, model)
            yield record
            if record.succeeded:
                return
