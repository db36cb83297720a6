"""Algorithm 1 with options that save hardware experiments."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from simbias.core import StudyWarning, Task
from simbias.core.errors import ConfigError
from simbias.core.files import ConfigFile
from simbias.core.ranges import Count, CountOrZero, NonNegative, Positive, Share
from simbias.core.records import Array, Iteration, Learning, Rollout
from simbias.search.optimizer.trajectory_candidates import follower
from simbias.trial.claim import Confidence, check_passes, passes_for
from simbias.trial.disk import read_json
from simbias.trial.method import Method
from simbias.trial.model_selection import log_likelihoods, most_likely
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, learn, random_experiment, search
from simbias.trial.study import Study


@dataclass(eq=False)
class ModelBased(Method):
    """Alternate policy search in simulation with hardware experiments and learning, like Algorithm 1.

    With the defaults, it is Algorithm 1.

    Parameters
    ----------
    max_iterations
        N_out.
    experiments
        Hardware experiments of an iteration.
    keep_data
        Whether to keep the data after a search that ends above Z_max, where Algorithm 1 clears the model.
    stop_at_failure
        Whether the first failure ends an iteration's experiments: the policy is refuted, and the next one may
        be more informative.
    retry_search
        How often a search that ends above the target cost is repeated before hardware is spent on its policy.
    target_cost
        Predicted cost Z below which a search has succeeded, at most Z_max. None: Z_max.
    posterior_scale
        In each repeated search, the deviations of models drawn from an identified posterior are multiplied by
        this factor: with few data, no policy may hold on all plausible models.
    passes
        Experiments that a policy has to pass to succeed, at least `experiments`. None: `experiments`.
        Experiments beyond these are made only as long as all are passed.
    confidence
        Share of starts that the policy must be shown to hold: success takes as many passes as establish this
        bound (`simbias.trial.claim`), regardless of `passes`. None: not required.
    model_selection
        Whether to search on the model that best predicts held-out experiments: the nominal model as declared,
        with identified parameters, or also with a bias (`simbias.trial.model_selection`). Otherwise the last
        of these is used.
    margin
        Number of standard errors by which a model has to predict better than a simpler one to be selected.
    from_last
        Whether a search evaluates the last policy first; it may begin there.
    first_policy
        A file with a policy's `parameters`, such as a search or an iteration in another trial's folder. The
        first search evaluates this policy first, and may begin there.
    lqr_candidates
        Number of models (the most probable one and draws) whose LQR policies (`simbias.search.lqr`) a search
        evaluates first.
    trajectories
        Number of trajectories that a search plans on the model (`simbias.search.optimizer.ilqr`), from
        different initial inputs. The search first evaluates policies that follow the best one. Only with
        `from_last` are they compared with the last policy, which the hardware has refuted but which may cost
        less on the corrected model. If the best one misses the goal and is refuted already, others are
        planned. Requires policy=trajectory.
    patient_plans
        Whether a plan is improved until ten iterations (three if it began at rest) save less than 0.01%
        instead of 1% of its cost, or for 500 iterations instead of 200.
    random_experiments
        Experiments with random inputs instead of a policy before the first search (J in PILCO). They count as
        experiments, and are learned from.
    """

    max_iterations: Count = 10
    experiments: Count = 2
    keep_data: bool = False
    stop_at_failure: bool = False
    retry_search: CountOrZero = 0
    target_cost: Positive | None = None
    posterior_scale: Share = 1.0
    passes: Count | None = None
    model_selection: bool = False
    lqr_candidates: CountOrZero = 0
    trajectories: CountOrZero = 0
    from_last: bool = False
    first_policy: ConfigFile | None = None
    confidence: Confidence | None = None
    margin: NonNegative = 0.0
    random_experiments: CountOrZero = 0
    patient_plans: bool = False

    def __post_init__(self) -> None:
        check_passes(self.passes, self.experiments)

    @property
    def source_files(self) -> list[Path]:
        """The first policy's file, if it exists."""
        file = Path(self.first_policy or "")
        return [file] if file.is_file() else []

    @cached_property
    def max_experiments(self) -> int:
        """Hardware experiments of a trial that never succeeds, at most."""
        return self.random_experiments + super().max_experiments

    def passes_of(self, policy: int) -> int:
        """Experiments that the policy of this number has to pass."""
        return passes_for(self.confidence, policy, self.experiments, self.passes)

    def check(self, study: Study) -> None:
        """Refuse another policy's parameters, a policy that follows no plan, and unlimited random inputs.

        Warn of a budget that no policy can pass.
        """
        most, least = study.budget.experiments, self.random_experiments + self.passes_of(0)
        if most and most < least:
            words = f"budget.experiments={most} allows no success, which needs {least}"
            warnings.warn(words, StudyWarning, stacklevel=2)
        list(self._known(study))
        if self.trajectories:
            follower(study.task, study.policy)
        if self.random_experiments:
            _check_random_inputs(study.task)

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every iteration."""
        search_rng, hardware_rng = rng.spawn(2)
        data, model = study.no_data, study.first_model()
        experiments: list[Rollout] = []
        learned_from: list[tuple[Rollout, ...]] = []  # the experiments that D comes from
        last: Iterable[Array] = self._known(study)
        refuted: list[Array] = []
        for random_rng in hardware_rng.spawn(self.random_experiments):
            experiments.append(random_experiment(study, random_rng, observer))
            learned_from.append((experiments[-1],))
        if experiments:
            model, data = learn(study, experiments, learned_from)
        for index in range(self.max_iterations):
            clock = Stopwatch()
            with clock("search"):
                found = search(
                    *(study, model, search_rng, observer),
                    lqr_candidates=self.lqr_candidates,
                    retries=self.retry_search,
                    target_cost=self.target_cost,
                    posterior_scale=self.posterior_scale,
                    last=last,
                    trajectories=self.trajectories,
                    refuted=refuted,
                    patient=self.patient_plans,
                )
            theta, simulation = found.optimum.parameters, model
            last = [theta] if self.from_last else []
            refuted = [*refuted, theta]
            reset = found.predicted_cost > study.cost.max_cost and not self.keep_data
            if reset:
                data, learned_from = study.no_data, []
            with clock("experiments"):
                before_stop = 1 if self.stop_at_failure else self.experiments
                passes = self.passes_of(index)
                rollouts = experiment(study, model, theta, hardware_rng, observer, passes, before_stop)
            experiments += rollouts
            succeeded = all(map(study.passes, rollouts))
            likelihoods: dict[str, float] = {}
            with clock("learning"):
                if not succeeded:
                    learned_from.append(rollouts)
                    likelihoods = (
                        log_likelihoods(study, experiments, self.margin) if self.model_selection else {}
                    )
                    model, data = learn(study, experiments, learned_from, most_likely(likelihoods))
                selection = study.select(rollouts, model.nominal)
            learning = Learning(selection, data, reset, likelihoods)
            made = len(experiments)
            yield iteration_record(study, index, theta, rollouts, made, clock, simulation, found, learning)
            if succeeded:
                return

    def _known(self, study: Study) -> Iterator[Array]:
        """The first policy's parameters (p,), if given; read when a search needs them, not in a replay."""
        if self.first_policy is None:
            return
        theta, p = read_json(Path(self.first_policy)).get("parameters"), study.policy.n_parameters
        if not isinstance(theta, list) or [type(each) in (int, float) for each in theta] != p * [True]:
            raise ConfigError("method.first_policy", f"{self.first_policy} needs `parameters`: {p} numbers")
        yield np.array(theta, dtype=np.float64)


def _check_random_inputs(task: Task) -> None:
    """Refuse a task whose inputs cannot be drawn at their limits and applied without feedback."""
    if task.targets:
        raise ConfigError("method.random_experiments", "must be 0 for a task with targets")
    for each, largest in zip(task.inputs, np.max(np.abs(task.input_bounds), axis=0).tolist(), strict=True):
        if largest == np.inf:
            raise ConfigError("method.random_experiments", f"need limits of all inputs; {each.name} has none")
