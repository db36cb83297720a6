"""The steps that methods are composed of: search, experiment, learn."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from simbias.interfaces import FittedBias, Objective, Observer
from simbias.records import Array, Optimum, Rollout
from simbias.study import Study


def search(
    study: Study,
    fitted_bias: FittedBias,
    rng: np.random.Generator,
    observer: Observer,
    candidates: Sequence[Array] = (),
    retries: int = 0,
    satisfactory: float | None = None,
) -> tuple[Optimum, float]:
    """Optimise the policy in simulation (the dashed loop of Fig. 1); return it with its predicted cost.

    A search that ends above a satisfactory cost, by default Z_max, is made again with other random numbers,
    up to `retries` times. The best one is returned, with the evaluations of all.
    """
    enough = study.cost.max_cost if satisfactory is None else satisfactory
    found = [_search(study, fitted_bias, rng, observer, candidates, enough)]
    while found[-1][1] > enough and len(found) <= retries:
        found.append(_search(study, fitted_bias, rng, observer, candidates, enough))
    best = min(range(len(found)), key=lambda index: found[index][1])
    optimum, predicted_cost = found[best]
    if len(found) > 1:
        optimum = replace(
            optimum,
            evaluations=sum(one.evaluations for one, _ in found),
            stopped_by=f"{optimum.stopped_by}, in search {best + 1} of {len(found)}",
        )
    return optimum, predicted_cost


def _search(
    study: Study,
    fitted_bias: FittedBias,
    rng: np.random.Generator,
    observer: Observer,
    candidates: Sequence[Array],
    satisfactory: float,
) -> tuple[Optimum, float]:
    """One search."""
    objective = study.evaluation.objective(study.model(fitted_bias), study.cost, rng)
    lower, upper = study.policy.bounds
    watched = _Watched(objective, observer)
    optimum = study.optimizer.minimize(watched, lower, upper, rng, satisfactory, candidates)
    return optimum, objective(optimum.parameters)


class _Watched:
    """An objective that tells an observer of its evaluations."""

    def __init__(self, objective: Objective, observer: Observer) -> None:
        self._objective = objective
        self._observer = observer
        self._evaluations, self._best = 0, np.inf
        if hasattr(objective, "together"):
            self.together = self._together

    def __call__(self, theta: Array) -> float:
        cost = self._objective(theta)
        self._tell(np.array([cost]))
        return cost

    def _together(self, thetas: Array) -> Array:
        costs = self._objective.together(thetas)
        self._tell(costs)
        return costs

    def _tell(self, costs: Array) -> None:
        self._evaluations += len(costs)
        self._best = min(self._best, *costs)
        self._observer.searching(self._evaluations, self._best)


def experiment(
    study: Study,
    theta: Array,
    rng: np.random.Generator,
    observer: Observer,
    iteration: int,
    count: int,
    stop_at: float = np.inf,
) -> tuple[Rollout, ...]:
    """Evaluate a policy with hardware experiments (the solid loop of Fig. 1).

    Once one costs `stop_at`, no more are made; this changes nothing in those of later iterations.
    """
    rollouts: list[Rollout] = []
    for index, experiment_rng in enumerate(rng.spawn(count)):
        rollouts.append(study.experiment(theta, experiment_rng))
        observer.experimented(iteration, index, theta, rollouts[-1])
        if rollouts[-1].cost >= stop_at:
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
