"""The steps that methods are composed of: search, experiment, learn."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np

from simbias.core import Model, Objective
from simbias.core.records import Array, Flags, Optimum, Rollout, Search
from simbias.trial.study import Observer, Study


def search(
    study: Study,
    model: Model,
    rng: np.random.Generator,
    observer: Observer,
    candidates: Sequence[Array] = (),
    retries: int = 0,
    satisfactory: float | None = None,
    narrowing: float = 1.0,
) -> Search:
    """Optimise the policy in simulation, on a corrected model (the dashed loop of Fig. 1).

    A search that ends above a satisfactory cost, by default Z_max, is made again with other random numbers,
    up to `retries` times, each time on draws from a posterior whose deviations are `narrowing` times those
    before. The best one is returned, with the evaluations of all.
    """
    enough = study.cost.max_cost if satisfactory is None else satisfactory
    searches: list[tuple[Optimum, float]] = []
    drawn = model
    while not searches or (searches[-1][1] > enough and len(searches) <= retries):
        (search_rng,) = rng.spawn(1)
        if searches:
            drawn = replace(drawn, nominal=drawn.nominal.narrowed(narrowing))
        searches.append(_search(study, drawn, search_rng, observer, candidates, enough))
    best = min(range(len(searches)), key=lambda index: searches[index][1])
    optimum, predicted_cost = searches[best]
    if len(searches) > 1:
        optimum = replace(
            optimum,
            evaluations=sum(one.evaluations for one, _ in searches),
            stopped_by=f"{optimum.stopped_by}, in search {best + 1} of {len(searches)}",
        )
    nominal = model.nominal
    found = Search(
        *(optimum, predicted_cost, model.bias, model.bias.diagnostics),
        *(nominal, nominal.estimates, dict(nominal.diagnostics)),
    )
    observer.searched(found)
    return found


def _search(
    study: Study,
    model: Model,
    rng: np.random.Generator,
    observer: Observer,
    candidates: Sequence[Array],
    satisfactory: float,
) -> tuple[Optimum, float]:
    """One search, and the cost that it predicts."""
    scenario_rng, optimizer_rng = rng.spawn(2)
    objective = study.evaluation.objective(model, study.cost, scenario_rng)
    lower, upper = study.policy.bounds
    watched = _Watched(objective, observer)
    optimum = study.optimizer.minimize(watched, lower, upper, optimizer_rng, satisfactory, candidates)
    return optimum, objective(optimum.parameters)


class _Watched:
    """An objective that tells an observer of its evaluations."""

    def __init__(self, objective: Objective, observer: Observer) -> None:
        self._objective = objective
        self._observer = observer
        self._evaluations, self._best = 0, np.inf
        if hasattr(objective, "together"):
            self.together = self._together
        if speculate := getattr(objective, "speculate", None):
            self.speculate = partial(self._speculate, speculate)

    @property
    def steps(self) -> int:
        """Simulated so far."""
        return getattr(self._objective, "steps", 0)

    def __call__(self, theta: Array) -> float:
        cost = self._objective(theta)
        self._tell(np.array([cost]))
        return cost

    def _together(self, thetas: Array) -> Array:
        costs = self._objective.together(thetas)
        self._tell(costs)
        return costs

    def _speculate(
        self, speculate: Callable[[Array], tuple[Array, Flags]], thetas: Array
    ) -> tuple[Array, Flags]:
        costs, known = speculate(thetas)
        self._tell(costs[known])
        return costs, known

    def _tell(self, costs: Array) -> None:
        self._evaluations += len(costs)
        self._best = min(self._best, *costs)
        self._observer.searching(self._evaluations, self._best)


def experiment(
    study: Study,
    theta: Array,
    rng: np.random.Generator,
    observer: Observer,
    count: int,
    least: int | None = None,
) -> tuple[Rollout, ...]:
    """Evaluate a policy with so many hardware experiments (the solid loop of Fig. 1).

    After the first `least`, by default all, none follows one that failed; this changes nothing in those of
    later iterations.
    """
    least = count if least is None else least
    rollouts: list[Rollout] = []
    for experiment_rng in rng.spawn(count):
        start = study.task.draw_start(experiment_rng)
        observer.experimenting(theta, start)
        rollouts.append(study.experiment(theta, experiment_rng, start))
        observer.experimented(rollouts[-1])
        if len(rollouts) >= least and not all(map(study.cost.passes, rollouts)):
            break
    return tuple(rollouts)


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
