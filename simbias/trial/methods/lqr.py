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
    """Try the policy that imitates the LQR of the nominal model, and optionally of identified models.

    The model is linearised by differences over 0.1 of each state's unit and of each input's limit, so that
    friction, which is steep near rest, is not mistaken for damping. Gains therefore differ from those of
    exact derivatives by up to 7% for the paper's robot, and by at most 1% for the cart-poles.

    Parameters
    ----------
    input_weight
        Weight of a squared input at its limit, relative to a squared state deviation of one unit. Smaller
        weights give faster regulators.
    experiments
        Hardware experiments of an iteration.
    passes
        Experiments that a policy has to pass to succeed, at least `experiments`. None: `experiments`.
        Experiments beyond these are made only as long as all are passed.
    identified
        Whether to learn from a failure: the nominal model's parameters are identified from all experiments,
        and the policy is redesigned.
    integral_weight
        Weight of the squared time integrals of the quantities that the policy integrates. It turns LQR into
        LQI: a steady disturbance leaves no error. 0: no integral.
    max_iterations
        The maximum number of designs, with identification; without it there is one.
    sticking
        Whether dry friction is treated as the damping that it resembles at rest (`simbias.search.lqr`).
    confidence
        Share of starts that the policy must be shown to hold: success takes as many passes as establish this
        bound (`simbias.trial.claim`), regardless of `passes`. None: not required.
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
        """Refuse a policy that cannot imitate such a regulator, or a model that has none."""
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
        """Yield a record of every iteration; errors as for `check`."""
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
