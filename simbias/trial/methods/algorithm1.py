"""Algorithm 1: Data-efficient reinforcement learning."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from simbias.core.ranges import Count, CountOrZero, Positive, Share
from simbias.core.records import Array, Iteration, Learning, Rollout
from simbias.search.lqr import Candidates
from simbias.trial.model_selection import learn, likeliest, log_likelihoods
from simbias.trial.steps import Stopwatch, experiment, search
from simbias.trial.study import Method, Observer, Study


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
    retry_spread
        In each further search, models are drawn from an identified posterior with this share of the
        deviations before: no policy may hold on all that few data allow.
    passes
        Experiments that a policy has to pass to succeed, at least `experiments`, which is what None means;
        those beyond are made only as long as all are passed.
    satisfactory_cost
        Predicted cost Z below which a search has ended satisfactorily; None is Z_max.
    warm_start
        Evaluate the trial's earlier policies first in a search.
    by_evidence
        Search on the model that predicts experiments best which it did not learn from: the nominal one as
        declared, with identified parameters, or with a bias too (`simbias.trial.model_selection`); else on
        the last.
    design
        Evaluate policies first that come near to linear-quadratic regulators (`simbias.search.lqr`) of so
        many models: the most probable one, and draws.
    """

    def __init__(
        self,
        max_iterations: Count = 10,
        experiments: Count = 2,
        keep_data: bool = False,
        stop_at_failure: bool = False,
        retry_search: CountOrZero = 0,
        satisfactory_cost: Positive | None = None,
        warm_start: bool = False,
        passes: Count | None = None,
        by_evidence: bool = False,
        design: CountOrZero = 0,
        retry_spread: Share = 1.0,
    ) -> None:
        if passes is not None and passes < experiments:
            raise ValueError(f"passes: {passes} are fewer than the {experiments} experiments of an iteration")
        self.max_iterations = max_iterations
        self._passes = passes or experiments
        self.max_experiments = max_iterations * self._passes
        self._experiments = experiments
        self._keep_data = keep_data
        self._stop_at_failure = stop_at_failure
        self._retry_search = retry_search
        self._satisfactory_cost = satisfactory_cost
        self._warm_start = warm_start
        self._by_evidence = by_evidence
        self._design = design
        self._retry_spread = retry_spread

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration; comments give the listing's lines."""
        search_rng, hardware_rng = rng.spawn(2)
        max_cost = study.cost.max_cost
        data = study.no_data  # 1
        model = study.model(study.bias.fit(data))
        experiments: list[Rollout] = []
        taught: list[tuple[Rollout, ...]] = []  # those of them that D comes from
        earlier: list[Array] = []
        for i in range(self.max_iterations):  # 2, 3, 15
            clock = Stopwatch()
            with clock("search"):
                first = Candidates(earlier, model, self._design)
                proposal = search(
                    *(study, model, search_rng, observer, first),
                    *(self._retry_search, self._satisfactory_cost, self._retry_spread),
                )  # 4, 5
            theta = proposal.optimum.parameters
            if self._warm_start:
                earlier.append(theta)
            reset = proposal.predicted_cost > max_cost and not self._keep_data  # 6
            if reset:
                data, taught = study.no_data, []  # 7
            with clock("experiments"):
                least = 1 if self._stop_at_failure else self._experiments
                rollouts = experiment(study, theta, hardware_rng, observer, self._passes, least)  # 9
            experiments += rollouts
            succeeded = all(map(study.cost.passes, rollouts))  # 10
            evidence: dict[str, float] = {}
            with clock("learning"):
                if not succeeded:
                    taught.append(rollouts)
                    evidence = log_likelihoods(study, experiments) if self._by_evidence else {}
                    model, data = learn(study, likeliest(evidence), experiments, taught)  # 13, 14
                selection = study.samples.select(rollouts, model.nominal)
            yield Iteration(
                index=i,
                parameters=theta,
                experiments=rollouts,
                hardware_cost=max(rollout.cost for rollout in rollouts),
                succeeded=succeeded,
                total_experiments=len(experiments),
                search=proposal,
                learning=Learning(selection, data, reset, evidence),
                seconds=clock.seconds,
            )
            if succeeded:  # 11
                return
