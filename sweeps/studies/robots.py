"""The robots that ship: how many experiments until success, by each method, and by what others would do.

    python sweeps/studies/robots.py FILE PRESET ... [--seeds 10] [--experiments 40] [--ways WAY ...]

tries, for each preset and seed,

- `preset`: the preset as it stands; `paper`, `robust`: with the method of `preset=paper`, `preset=robust`;
- `lqr`: LQR from the nominal model, linearised at the equilibrium;
- `least_squares`: LQR from a linear model of the data, at first the nominal model's policy; fitted anew and
  tried again after each experiment that fails, with the nominal model as prior;
- `bayesian`: Bayesian optimisation of the trial's own policy on the hardware: of the logarithm of an
  experiment's cost.

and writes the experiments until a policy passes two in a row, the seconds, and in how many of 20 test
episodes the last policy balances. `pip install 'simbias[study]'`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts
from scipy.linalg import solve_discrete_are

import simbias
from simbias.core import Policy, Task
from simbias.core.records import Array, Rollout
from simbias.trial.study import Study

METHODS = ("preset", "paper", "robust")
STEP = 1e-5  # of states and inputs, in their units, for derivatives
PRIOR = 1e-3  # weight of the nominal model's linearisation against a sample, in scaled units
SCALES = {"m": 0.1, "rad": 0.1, "m/s": 1.0, "rad/s": 1.0}  # of states: 1/x^2 weighs them (Bryson's rule)


class StateFeedback(Policy):
    """u = K x, within the limits; theta is K (m, n), row by row."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.n_parameters = len(task.inputs) * len(task.states)
        self.bounds = np.full(self.n_parameters, -np.inf), np.full(self.n_parameters, np.inf)

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n)."""
        K = theta.reshape(*theta.shape[:-1], len(self._task.inputs), len(self._task.states))
        u = (K @ x[..., None])[..., 0]
        return np.clip(u, -self._task.input_limit, self._task.input_limit), memory


def linearised(study: Study) -> tuple[Array, Array]:
    """A (n, n) and B (n, m) of the nominal model at the equilibrium, where all states are zero."""
    n, m = len(study.task.states), len(study.task.inputs)
    steps = STEP * np.eye(n + m)
    plus, minus = (study.nominal.step(s[:, :n], s[:, n:]) for s in (steps, -steps))
    slopes = (plus - minus).T / (2 * STEP)
    return slopes[:, :n], slopes[:, n:]


def lqr(task: Task, A: Array, B: Array) -> Array | None:
    """The gains (m n,) of u = K x; None if no policy stabilises that model."""
    scales = np.array([SCALES[state.unit] for state in task.states])
    Q, R = np.diag(1 / scales**2), np.diag(1 / task.input_limit**2)
    try:
        S = solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return -np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A).ravel()


def fitted(task: Task, A: Array, B: Array, rollouts: list[Rollout]) -> tuple[Array, Array]:
    """A and B by least squares from experiments, the nominal model's as prior."""
    n = len(task.states)
    scales = np.concatenate([[SCALES[state.unit] for state in task.states], task.input_limit])
    z = np.concatenate([np.hstack([r.states[:-1], r.inputs]) for r in rollouts]) / scales
    prior = np.hstack([A, B]) * scales
    errors = np.concatenate([r.states[1:] for r in rollouts]) - z @ prior.T
    found = prior + np.linalg.solve(z.T @ z + PRIOR * np.eye(z.shape[1]), z.T @ errors).T
    found = found / scales
    return found[:, :n], found[:, n:]


def by_lqr(study: Study, learns: bool) -> Iterator[Array]:
    """Policies to try, one after the other; told of experiments by `send`."""
    A, B = linearised(study)
    theta = lqr(study.task, A, B)
    rollouts: list[Rollout] = []
    while theta is not None:
        rollout = yield theta
        if not learns:
            return
        rollouts.append(rollout)
        theta = lqr(study.task, *fitted(study.task, A, B, rollouts))


def by_bayesian_optimisation(study: Study, seed: int) -> Iterator[Array]:
    """Policies to try, one after the other; told of experiments by `send`."""
    from bayes_opt import BayesianOptimization

    low, high = study.policy.bounds
    box = {f"p{i:02}": (float(a), float(b)) for i, (a, b) in enumerate(zip(low, high, strict=True))}
    search = BayesianOptimization(None, box, random_state=seed, verbose=0, allow_duplicate_points=True)
    rng = np.random.default_rng(seed)
    for number in range(10**6):
        drawn = dict(zip(box, rng.uniform(low, high), strict=True))
        point = drawn if number < 2 * len(box) else search.suggest()
        rollout = yield np.array([point[name] for name in sorted(point)])
        search.register(point, -np.log10(max(rollout.cost, 1e-6)))


def tried(preset: str, way: str, seed: int, most: int, overrides: Sequence[str]) -> dict[str, Any]:
    """Experiments until a policy passes two in a row, and what it is worth; a method makes 20 at most."""
    presets = f"[{preset},{way}]" if way in METHODS[1:] else preset
    study = simbias.load([f"preset={presets}", "tracking=none", f"seed={seed}", *overrides])
    began = time.perf_counter()
    if way in METHODS:
        *_, last = study.run()
        return _row(preset, way, seed, study, last.parameters, last.succeeded, last.total_experiments, began)
    if way in ("lqr", "least_squares"):
        study = replace(study, policy=StateFeedback(study.task))
    policies: dict[str, Callable[[], Any]] = {
        "lqr": lambda: by_lqr(study, learns=False),
        "least_squares": lambda: by_lqr(study, learns=True),
        "bayesian": lambda: by_bayesian_optimisation(study, seed),
    }
    rng, made, succeeded = np.random.default_rng(seed), 0, False
    source, theta = policies[way](), None
    answer: Rollout | None = None
    while made < most and not succeeded:
        try:
            theta = next(source) if answer is None else source.send(answer)
        except StopIteration:
            break
        for _ in range(2):
            answer = study.experiment(theta, rng.spawn(1)[0])
            made += 1
            succeeded = study.cost.passes(answer)
            if not succeeded:
                break
    return _row(preset, way, seed, study, theta, succeeded, made, began)


def _row(
    preset: str,
    way: str,
    seed: int,
    study: Study,
    theta: Array | None,
    succeeded: bool,
    made: int,
    began: float,
) -> dict[str, Any]:
    """What came of a trial, and in how many test episodes its last policy balances."""
    return {
        "preset": preset,
        "way": way,
        "seed": seed,
        "succeeded": succeeded,
        "experiments": made,
        "seconds": round(time.perf_counter() - began, 1),
        "test_successes": 0 if theta is None else balanced_starts(study, theta),
        "test_episodes": STARTS,
    }


WAYS = (*METHODS, "lqr", "least_squares", "bayesian")

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("presets", nargs="+", metavar="PRESET")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--experiments", type=int, default=40, help="that a way may make")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="of every trial's config")
    arguments = parser.parse_args()
    rows = Parallel(n_jobs=2)(
        delayed(tried)(preset, way, seed, arguments.experiments, arguments.set)
        for preset in arguments.presets
        for way in arguments.ways
        for seed in range(arguments.seeds)
    )
    table = pd.DataFrame(rows)
    table.to_csv(arguments.file, index=False, lineterminator="\n")
    measures = ["succeeded", "experiments", "test_successes", "seconds"]
    print(table.groupby(["preset", "way"], sort=False)[measures].mean())
