"""The paper's premise and the first row of its Table II, measured.

`python sweeps/studies/premise.py FOLDER [override ...]` tells for each of 10 seeds, without noise and inertia
error if not overridden, how many hardware experiments Algorithm 1 needs, and in how many of 20 random starts
its last policy balances the hardware; in how many of 200 the first one does, which is of the nominal model
alone and the same for every seed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

import simbias
from simbias.core.proportions import counted_share
from simbias.core.records import Array
from simbias.testing.studies import warm_up
from simbias.trial.policy_test import PolicyTest, run_policy_test
from simbias.trial.study import Study

SEEDS = range(10)
STARTS = 20
STARTS_OF_FIRST = 200


def balanced_starts(study: Study, theta: Array, starts: int = STARTS) -> int:
    """In how many test episodes theta balances the hardware, for the task's horizon."""
    test = run_policy_test(study, theta, PolicyTest(starts, long_episodes=0))
    assert test is not None
    return test.successes.count("1")


def measure(seed: int, overrides: Sequence[str]) -> dict[str, Any]:
    """One trial, and its last policy on other starts."""
    study = simbias.load(["tracking=none", *overrides, f"seed={seed}"])
    warm_up(study)
    began = time.perf_counter()
    *_, last = study.run()
    seconds = time.perf_counter() - began
    assert last.learning is not None
    return {
        "seed": seed,
        "succeeded": last.succeeded,
        "experiments": last.total_experiments,
        "samples": len(last.learning.data),
        "last_policy_balances": balanced_starts(study, last.parameters),
        "starts": STARTS,
        "seconds": round(seconds, 1),
    }


def main(folder: Path, overrides: Sequence[str]) -> None:
    """Measure the first policy and every seed, print the numbers and write them as CSV."""
    study = simbias.load(["tracking=none", *overrides])
    first = {
        "balances": balanced_starts(study, next(study.run()).parameters, STARTS_OF_FIRST),
        "starts": STARTS_OF_FIRST,
    }
    rows = Parallel(n_jobs=2)(delayed(measure)(seed, overrides) for seed in SEEDS)
    for name, table in (("first_policy", [first]), ("premise", rows)):
        pd.DataFrame(table).to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
    print(f"the first policy balances {counted_share(first['balances'], first['starts'])}")
    for row in rows:
        print("  ".join(f"{key} {value}" for key, value in row.items()))
    experiments = [row["experiments"] for row in rows]
    print(
        f"{sum(row['succeeded'] for row in rows)} of {len(rows)} succeed, {np.mean(experiments)} experiments"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("overrides", nargs="*")
    arguments = parser.parse_args()
    main(arguments.folder, arguments.overrides)
