"""How long a sweep may take."""

from __future__ import annotations

import time
from statistics import mean
from typing import NamedTuple

import numpy as np
from pandas import DataFrame

from simbias.core.messages import counted
from simbias.core.records import Transitions
from simbias.sweep.grid import Sweep
from simbias.trial.study import Study

SAMPLES = 150  # of training data in the middle of a trial
FRAMES = 0.75  # of the horizon, for which a policy balances on average in a search
POLICIES = 32  # that are simulated to measure the speed


class Estimate(NamedTuple):
    """Seconds that a sweep's missing trials may take, and what that rests on."""

    least: float  # if each first policy succeeds
    most: float  # if none does, in as many iterations as there may be
    basis: str


def estimate(sweep: Sweep, finished: DataFrame, study: Study, n_jobs: int) -> Estimate:
    """From the means of finished trials, cell by cell where there are any, or from simulation's speed."""
    missing = [trial for trial in sweep.trials if trial.hash not in set(finished["hash"])]
    if not len(finished):
        first, later = _search_seconds(study, 0), _search_seconds(study, SAMPLES)
        most = first + (study.method.max_iterations - 1) * later
        least, most = (len(missing) * seconds / n_jobs for seconds in (first, most))
        return Estimate(least, most, "rough: as fast as this machine simulates, without the hardware")
    seconds: dict[tuple[str, ...], list[float]] = {}
    for row in finished.to_dict("records"):
        seconds.setdefault(tuple(row[axis.name] for axis in sweep.axes), []).append(row["seconds"])
    overall = list(finished["seconds"])
    total = sum(mean(seconds.get(trial.cell.labels, overall)) for trial in missing) / n_jobs
    return Estimate(total, total, f"from {counted(len(finished), 'finished trial')}")


def _search_seconds(study: Study, samples: int) -> float:
    """Time of a search in s, extrapolated from a frame's, with a bias learned from `samples` samples."""
    task, evaluation, rng = study.task, study.evaluation, np.random.default_rng(0)
    n, m = len(task.states), len(task.inputs)
    transitions = Transitions(rng.normal(0.0, 0.1, (samples, n + m)), np.zeros((samples, n)))
    objective = evaluation.objective(study.model(study.bias.fit(transitions)), study.cost, rng)
    lower, upper = study.policy.bounds
    thetas = rng.uniform(lower, upper, (POLICIES, len(lower)))
    together = getattr(objective, "together", lambda points: [objective(point) for point in points])
    together(thetas)  # compiles
    start, before = time.perf_counter(), getattr(objective, "steps", 0)
    together(thetas)
    seconds, steps = time.perf_counter() - start, getattr(objective, "steps", 0) - before
    if not steps:  # a plain function counts none
        return study.optimizer.max_evaluations * seconds / POLICIES
    frames = FRAMES * evaluation.rollouts * (evaluation.horizon or task.horizon)
    return study.optimizer.max_evaluations * frames * seconds / steps
