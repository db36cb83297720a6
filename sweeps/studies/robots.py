"""The robots that ship: how many experiments until success, by each method, and by what others would do.

    python sweeps/studies/robots.py FILE PRESET ... [--seeds 10] [--experiments 40] [--ways WAY ...]

tries, for each preset and seed,

- `preset`: the preset as it stands; `paper`, `robust`: with the method of `preset=paper`, `preset=robust`;
- `lqr`: LQR of the nominal model (`method=lqr`), one policy, and nothing is learned;
- `bayesian`: Bayesian optimisation of the trial's own policy on the hardware: of the logarithm of an
  experiment's cost.

and writes the experiments until a policy passes two in a row, the seconds, and in how many of 20 test
episodes the last policy balances; these last as long as an experiment, or as `--test SECONDS` says.
`pip install 'simbias[study]'`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts

import simbias
from simbias.core.records import Array, Rollout
from simbias.trial.study import Study

METHODS = {  # overrides, of {preset}
    "preset": ["preset={preset}"],
    "paper": ["preset=[{preset},paper]"],
    "robust": ["preset=[{preset},robust]"],
    "lqr": ["preset={preset}", "method=lqr", "policy=regulator", "identification=none", "bias=none"],
}
WAYS = (*METHODS, "bayesian")


def by_bayesian_optimisation(study: Study, seed: int) -> Generator[Array, Rollout]:
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


def tried(
    preset: str, way: str, seed: int, most: int, seconds: float | None, overrides: Sequence[str]
) -> dict[str, Any]:
    """Experiments until a policy passes two in a row, and what it is worth; a method makes 20 at most."""
    chosen = [override.format(preset=preset) for override in METHODS.get(way, METHODS["preset"])]
    study = simbias.load([*chosen, "tracking=none", f"seed={seed}", *overrides])
    began = time.perf_counter()
    if way in METHODS:
        *_, last = study.run()
        theta, succeeded, made = last.parameters, last.succeeded, last.total_experiments
    else:
        theta, succeeded, made = passed(study, by_bayesian_optimisation(study, seed), seed, most)
    took = time.perf_counter() - began
    if seconds is not None:
        study = study.with_horizon(study.task.frames(seconds))
    return {
        "preset": preset,
        "way": way,
        "seed": seed,
        "succeeded": succeeded,
        "experiments": made,
        "seconds": round(took, 1),
        "test_successes": balanced_starts(study, theta),
        "test_episodes": STARTS,
    }


def passed(
    study: Study, policies: Generator[Array, Rollout], seed: int, most: int
) -> tuple[Array, bool, int]:
    """The last policy that was tried, whether it passed two experiments in a row, and how many were made."""
    rng, made = np.random.default_rng(seed), 0
    theta = next(policies)
    while True:
        for _ in range(2):
            answer = study.experiment(theta, rng.spawn(1)[0])
            made += 1
            succeeded = study.cost.passes(answer)
            if not succeeded:
                break
        if succeeded or made >= most:
            return theta, succeeded, made
        theta = policies.send(answer)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("presets", nargs="+", metavar="PRESET")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--experiments", type=int, default=40, help="that a way may make")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--test", type=float, metavar="SECONDS", help="of a test episode")
    parser.add_argument("--set", nargs="+", default=[], metavar="OVERRIDE", help="of every trial's config")
    arguments = parser.parse_args()
    rows = Parallel(n_jobs=2)(
        delayed(tried)(preset, way, seed, arguments.experiments, arguments.test, arguments.set)
        for preset in arguments.presets
        for way in arguments.ways
        for seed in range(arguments.seeds)
    )
    table = pd.DataFrame(rows)
    table.to_csv(arguments.file, index=False, lineterminator="\n")
    measures = ["succeeded", "experiments", "test_successes", "seconds"]
    print(table.groupby(["preset", "way"], sort=False)[measures].mean())
