"""Search for policies of RealAIGym's boards of simulations, and score them as the boards do.

    python sweeps/studies/board/searches.py OUT --robots pendubot acrobot --seeds 1 2 3

Each trial of `preset=pendubot_board` and `acrobot_board` appends a row to OUT/searches.csv: the scores of its
last policy by `score.py`, with noise and pushes of seed 20, its parameters, and by what the best one can be
chosen without these scores: the share of 600 scenarios drawn from the ranges that it holds. A row that is
there is not made again. `--again` scores the parameters in OUT/searches.csv without a search, and prints what
differs.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from score import DRIVEN, Asked, development_score, scores

import simbias
from simbias.core.records import Array
from simbias.trial.policy_test import run_policy_test
from simbias.trial.run import run_trial
from simbias.trial.study import Study

NOISE = 20  # seed of noise and pushes, used for no choice


def main() -> None:
    """Search and score what is missing, or score again what is there."""
    parser = argparse.ArgumentParser(prog="searches")
    parser.add_argument("out", type=Path)
    parser.add_argument("--robots", nargs="+", choices=DRIVEN, default=DRIVEN)
    parser.add_argument("--seeds", nargs="+", type=int, default=range(1, 11))
    parser.add_argument("--again", action="store_true", help="score the policies in OUT/searches.csv")
    arguments = parser.parse_args()
    file = arguments.out / "searches.csv"
    known = pd.read_csv(file) if file.exists() else pd.DataFrame(columns=["robot", "seed"])
    if arguments.again:
        for row in known.to_dict("records"):
            print(row["robot"], row["seed"], differences(row), flush=True)
        return
    done = set(zip(known["robot"], known["seed"], strict=True))
    for seed in arguments.seeds:
        for robot in [robot for robot in arguments.robots if (robot, seed) not in done]:
            row = pd.DataFrame([searched(robot, seed)])
            row.to_csv(file, mode="a", header=not file.exists(), index=False, float_format="%.4f")


def differences(row: Mapping[Any, Any]) -> str:
    """How the scores of a row's policy differ from the row's."""
    new = of_policy(row["robot"], parameters(row))
    found = [
        f"{name} {row[name]:.4f}, now {new[name]:.4f}" for name in new if abs(new[name] - row[name]) > 1e-4
    ]
    return "; ".join(found) or "the same"


def searched(robot: str, seed: int) -> dict[str, object]:
    """The row of a trial."""
    trial = run_trial(simbias.load([f"preset={robot}_board", f"seed={seed}"]))
    summary, theta = trial.summary, trial.iterations[-1].parameters
    return {
        "robot": robot,
        "seed": seed,
        "hash": trial.study.hash,
        "seconds": round(summary.seconds),
        **of_policy(robot, theta),
        "parameters": " ".join(map(repr, theta.tolist())),
    }


def of_policy(robot: str, theta: Array) -> dict[str, float]:
    """Scores of theta (p,) with the preset's policy, and what it can be chosen by.

    That is successes in 20 test episodes on the preset's hardware, and the score of development.
    """
    study, joint = study_of(robot), DRIVEN.index(robot)
    test, law = run_policy_test(study, theta, study.policy_test), Asked(study.policy, study.task, theta)
    assert test is not None
    own = {
        "test_episodes": float(test.successes.count("1")),
        "development": development_score(law, joint),
    }
    return own | scores(law, joint, NOISE)


def study_of(robot: str) -> Study:
    """The preset's study, with a test."""
    return simbias.load([f"preset={robot}_board", "policy_test.episodes=20"])


def parameters(row: Mapping[Any, Any]) -> Array:
    """The policy's parameters (p,) in a row."""
    return np.array([float(each) for each in row["parameters"].split()])


if __name__ == "__main__":
    main()
