"""How long a sweep may take."""

from __future__ import annotations

import time
from statistics import mean

import numpy as np
from pandas import DataFrame

from simbias.records import Transitions
from simbias.study import Study
from simbias.sweep.grid import Sweep

SAMPLES = 150  # of training data in the middle of a trial
ITERATIONS = 0.5  # of those that a trial may make
FRAMES = 0.75  # of the horizon, which a policy balances on average in a search
POLICIES = 32  # that are simulated to measure the speed


def estimate(sweep: Sweep, finished: DataFrame, study: Study, n_jobs: int) -> tuple[float, str]:
    """Seconds that the missing trials may take, and what that rests on.

    The means of finished trials, cell by cell where there are any; otherwise the speed of simulation.
    """
    missing = [trial for trial in sweep.trials if trial.hash not in set(finished["hash"])]
    if not len(finished):
        return len(missing) * _trial_seconds(
            study
        ) / n_jobs, "rough, from the speed of this machine's simulation"
    seconds: dict[tuple[str, ...], list[float]] = {}
    for row in finished.to_dict("records"):
        seconds.setdefault(tuple(row[axis.name] for axis in sweep.axes), []).append(row["seconds"])
    overall = list(finished["seconds"])
    total = sum(mean(seconds.get(trial.cell.labels, overall)) for trial in missing)
    return total / n_jobs, f"from {len(finished)} finished trials"


def _trial_seconds(study: Study) -> float:
    """A trial's time from that of a simulated frame: nearly all of it goes into policy searches."""
    task, rng = study.task, np.random.default_rng(0)
    n, m = len(task.states), len(task.inputs)
    no_residuals = Transitions(rng.normal(0.0, 0.1, (SAMPLES, n + m)), np.zeros((SAMPLES, n)))
    simulator = study.simulator(study.bias.fit(no_residuals))
    lower, upper = study.policy.bounds
    thetas = rng.uniform(lower, upper, (POLICIES, len(lower)))
    starts = np.tile(task.start_mean, (POLICIES, 1))
    simulator.rollouts(thetas, starts)  # compiles
    start = time.perf_counter()
    frames = sum(rollout.frames for rollout in simulator.rollouts(thetas, starts))
    a_frame = (time.perf_counter() - start) / max(frames, 1)
    iterations = ITERATIONS * study.method.max_iterations
    return iterations * study.optimizer.max_evaluations * FRAMES * task.horizon * a_frame
