"""The steps that methods are composed of: search, experiment, learn."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, tee
from typing import Any, NamedTuple

import numpy as np

from simbias.core import Model, Policy
from simbias.core.errors import ConfigError
from simbias.core.objective import Mapped
from simbias.core.records import Array, Iteration, Learning, Optimum, Rollout, Search, Transitions
from simbias.policy.trajectory import Trajectory
from simbias.search import lqr
from simbias.search.optimizer.trajectory_candidates import trajectory_candidates
from simbias.trial.observer import Observer
from simbias.trial.study import Study

RANDOM_KNOTS = 26  # of a random experiment: a new input every 25th of the horizon


def search(
    study: Study,
    model: Model,
    rng: np.random.Generator,
    observer: Observer,
    *,
    lqr_candidates: int = 0,
    retries: int = 0,
    target_cost: float | None = None,
    posterior_scale: float = 1.0,
    last: Iterable[Array] = (),
    trajectories: int = 0,
    refuted: Sequence[Array] = (),
    patient: bool = False,
) -> Search:
    """Optimise the policy in simulation, on a corrected model (the dashed loop of Fig. 1).

    A search that ends above the target cost (by default and at most Z_max) is repeated with other random
    numbers, up to `retries` times. Each time, the deviations of draws from a posterior are multiplied by
    `posterior_scale`. The best optimum is returned, with the evaluations of all searches. Each first
    evaluates the last policies (p,), LQR policies of `lqr_candidates` models (`simbias.search.lqr`), and
    policies that follow the best of some trajectories (`simbias.search.optimizer.ilqr`), planned on the model
    with or without its bias, and others than the `refuted` policies (p,) if these miss the goal there.
    `patient` plans are improved for longer.

    Raises
    ------
    BudgetSpent
        If the budget would not allow trying the resulting policy.
    """
    study.spending.check()
    target = min(study.cost.max_cost, np.inf if target_cost is None else target_cost)
    searches: list[tuple[Optimum, float]] = []
    drawn = model
    models = (model, study.model(nominal=model.nominal)) if trajectories else (model,)
    planned = trajectory_candidates(models, trajectories, study.cost.goal_weights, refuted, patient)
    designs = lqr.lqr_candidates(model, lqr_candidates), planned
    candidates: Iterator[Array] = chain(last, *designs)
    while not searches or (searches[-1][1] > target and len(searches) <= retries):
        (search_rng,) = rng.spawn(1)
        if searches:
            drawn = replace(drawn, nominal=drawn.nominal.narrowed(posterior_scale))
        candidates, own = tee(candidates)
        searches.append(_search(study, drawn, search_rng, observer, own, target))
    best = min(range(len(searches)), key=lambda index: searches[index][1])
    optimum, predicted_cost = searches[best]
    if len(searches) > 1:
        optimum = replace(
            optimum,
            evaluations=sum(one.evaluations for one, _ in searches),
            stopped_by=f"{optimum.stopped_by}, in search {best + 1} of {len(searches)}",
        )
    found = Search(optimum, predicted_cost)
    observer.designed(optimum.parameters, model, found)
    return found


def _search(
    study: Study,
    model: Model,
    rng: np.random.Generator,
    observer: Observer,
    candidates: Iterable[Array],
    target_cost: float,
) -> tuple[Optimum, float]:
    """The optimum of one search, and its predicted cost Z_g."""
    scenario_rng, optimizer_rng = rng.spawn(2)
    objective = study.evaluation.objective(model, study.cost, scenario_rng)
    evaluations, best = 0, np.inf

    def report(thetas: Array, costs: Array) -> Array:
        nonlocal evaluations, best
        evaluations, best = evaluations + len(costs), min(best, *costs)
        observer.searching(evaluations, best)
        return costs

    watched, policy = Mapped(objective, report), study.policy
    near: dict[str, Any] = (
        {} if type(policy).directions is Policy.directions else {"directions": policy.directions}
    )
    optimum = study.optimizer.minimize(
        watched, *policy.bounds, optimizer_rng, target_cost, candidates, **near
    )
    return optimum, objective(optimum.parameters)


def experiment(
    study: Study,
    model: Model | None,
    theta: Array,
    rng: np.random.Generator,
    observer: Observer,
    count: int,
    before_stop: int | None = None,
) -> tuple[Rollout, ...]:
    """Run `count` hardware experiments with a policy designed on a model (Fig. 1's solid loop).

    After the first `before_stop` experiments (by default all), a failure ends the series. This does not
    change the experiments of later iterations. Errors are those of `Study.experiment`.
    """
    before_stop = count if before_stop is None else before_stop
    own, rollouts = study.designed_on(model), list[Rollout]()
    for experiment_rng in rng.spawn(count):
        rollouts.append(own.experiment(theta, experiment_rng, observer=observer))
        if len(rollouts) >= before_stop and not all(map(study.passes, rollouts)):
            break
    return tuple(rollouts)


def random_experiment(study: Study, rng: np.random.Generator, observer: Observer) -> Rollout:
    """Run an experiment with random inputs, without a policy.

    At `RANDOM_KNOTS` times, each input is at one of its limits, drawn at random; between them, it is linear
    in time. Errors are those of `Study.experiment`.
    """
    input_rng, experiment_rng = rng.spawn(2)
    policy = Trajectory(study.task, study.nominal, RANDOM_KNOTS)
    n, m = len(study.task.states), len(study.task.inputs)
    inputs = np.where(input_rng.random((RANDOM_KNOTS, m)) < 0.5, *study.task.input_bounds)
    theta = policy.following(np.zeros((RANDOM_KNOTS, n)), inputs, np.zeros((RANDOM_KNOTS, m, n)))
    return replace(study, policy=policy).experiment(theta, experiment_rng, observer=observer)


class ModelVariant(NamedTuple):
    """A way to model the hardware."""

    identifies: bool = True  # whether it identifies the nominal model's parameters
    corrects: bool = True  # whether it corrects by a bias


class Learned(NamedTuple):
    """Result of lines 13 and 14 of Algorithm 1."""

    model: Model
    data: Transitions  # D, with residuals against this model's nominal model


def learn(
    study: Study,
    experiments: Sequence[Rollout],
    learned_from: Sequence[Sequence[Rollout]],
    variant: ModelVariant = ModelVariant(),  # noqa: B008 (it is immutable)
) -> Learned:
    """Identify parameters from all experiments, and learn a bias from those of some iterations."""
    nominal = study.identified(experiments) if variant.identifies else study.nominal
    data = study.no_data
    for rollouts in learned_from:  # D is the union of all D_i (line 13)
        data |= study.select(rollouts, nominal).transitions
    if not variant.corrects:
        return Learned(study.model(None, nominal), data)
    of_robot = study.of_robot(rollout for rollouts in learned_from for rollout in rollouts)
    return Learned(study.model(study.bias.learn(data, of_robot, nominal), nominal), data)


def iteration_record(
    study: Study,
    index: int,
    theta: Array,
    experiments: tuple[Rollout, ...],
    total_experiments: int,
    clock: Stopwatch,
    model: Model | None = None,
    search: Search | None = None,
    learning: Learning | None = None,
) -> Iteration:
    """The record of an iteration, which succeeds if all its experiments do (line 10).

    Its hardware cost Z_r is the largest of its experiments' costs (line 9); its policy was made on `model`.
    """
    cost = max(rollout.cost for rollout in experiments)
    succeeded = all(map(study.passes, experiments))
    made = model, search, learning, clock.seconds
    return Iteration(index, theta, experiments, cost, succeeded, total_experiments, *made)


def log_costs(costs: float | Sequence[float]) -> Array:
    """The logarithms ln Z of one cost or several (k,).

    Raises
    ------
    ConfigError
        If a cost is not positive.
    """
    if not (least := np.min(costs)) > 0:
        raise ConfigError("cost", f"is {least:.3g}; this method needs positive costs: it compares ln Z")
    return np.log(costs)


class Stopwatch:
    """Wall time of named phases."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        """Time a phase."""
        start = time.perf_counter()
        yield
        self.seconds[phase] = time.perf_counter() - start
