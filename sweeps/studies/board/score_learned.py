"""Score what was learned in RealAIGym's simulator with friction as their boards of simulations do.

    python sweeps/studies/board/score_learned.py OUT.csv trials/*

OUT.csv gets a row for the last policy of each trial with `hardware=their_simulator`, and one for its first,
if that failed. Scores are those of `score.py`, by noise and pushes of seed 20. The board's robot has no gap
to the model; in two more columns it has the hardware's friction, slow motor, late measurements and noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from plant import FRICTION
from score import DRIVEN, UNDISTURBED, Asked, Scenario, performance, robustness, scores
from searches import NOISE

import simbias
from simbias.trial.folder import TRIAL

CONF = Path(__file__).parent / "conf"


def gap_of(hardware: Mapping[str, Any], time_step: float, joint: int) -> Callable[[Scenario], Scenario]:
    """What gives a scenario a trial's hardware, except where the scenario itself says otherwise."""
    passive = f"c_{2 - joint}"
    friction = FRICTION | {passive: (1.0 - hardware["compensated"]) * FRICTION[passive]}
    gap = {
        "response": 1.0 - (1.0 - hardware["response"]) ** 2,  # in 2 ms; the hardware's is in 1 ms
        "delay": hardware["delay"] * time_step,
        "velocity_noise": hardware["noise"]["velocity_variance"] ** 0.5,
    }

    def changed(one: Scenario) -> Scenario:
        others = {name: value for name, value in gap.items() if name != one.kind.replace(" ", "_")}
        return replace(one, plant=(*friction.items(), *one.plant), **others)

    return changed


def scored(folder: Path) -> Iterator[dict[str, Any]]:
    """The rows of a trial."""
    trial = simbias.load_trial(folder, config_dir=CONF)
    config, joint = trial.study.config, int(trial.study.config["hardware"]["driven"] == "second")
    changed = gap_of(config["hardware"], trial.study.task.time_step, joint)
    for index in sorted({0, len(trial.iterations) - 1}):
        iteration, last = trial.iterations[index], index == len(trial.iterations) - 1
        study = trial.study.designed_on(iteration.model)
        law = Asked(study.policy, study.task, iteration.parameters)
        yield {
            "robot": DRIVEN[joint],
            "kind": config["policy"]["_target_"].split(".")[-2],
            "hash": trial.study.hash,
            "seed": config["seed"],
            "outcome": str(trial.outcome),
            "policy": "last" if last else "first",
            "experiments": int(trial.summary.experiments_until_success) if last else 0,
            "test_episodes": trial.summary.test_episodes.count("1") if last else "",  # of 10
            **scores(law, joint, NOISE),
            "robustness_with_gap": robustness(law, joint, NOISE, changed)["robustness"],
            "performance_with_gap": performance(law, joint, changed(UNDISTURBED)),
        }


def main(out: Path, folders: list[Path]) -> None:
    """Score all trials."""
    with np.errstate(invalid="ignore"):  # where a robot spins out of all bounds
        rows = pd.DataFrame([row for each in folders if (each / TRIAL).exists() for row in scored(each)])
    rows = rows.sort_values(["kind", "robot", "seed", "hash", "policy"])
    rows.to_csv(out, index=False, float_format="%.4f", lineterminator="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("trials", type=Path, nargs="+")
    arguments = parser.parse_args()
    main(arguments.file, arguments.trials)
