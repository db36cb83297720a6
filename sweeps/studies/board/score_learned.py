"""Score what was learned in RealAIGym's simulator with friction as their boards of simulations do.

    python sweeps/studies/board/score_learned.py OUT.csv

beside the folder `trials` of `+sweep=learned_on_their_simulator`. OUT.csv gets a row for each trial's last
policy, and one for its first, if that failed. Scores are those of `score.py`, by noise and pushes of seed 20.
The board's robot has no gap to the model; in two more columns it has the friction, slow motor, late
measurements and noise that were learned with.
"""

from __future__ import annotations

import sys
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
from simbias.sweep import results
from simbias.sweep.grid import expand

CONF, TRIALS = Path(__file__).parent / "conf", Path("trials")


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


def scored(row: dict[Any, Any]) -> Iterator[dict[str, Any]]:
    """The rows of a trial."""
    trial, joint = simbias.load_trial(TRIALS / row["hash"], config_dir=CONF), DRIVEN.index(row["robot"])
    changed = gap_of(trial.study.config["hardware"], trial.study.task.time_step, joint)
    for index in sorted({0, len(trial.iterations) - 1}):
        iteration = trial.iterations[index]
        study = trial.study.designed_on(iteration.model)
        law = Asked(study.policy, study.task, iteration.parameters)
        last = iteration is trial.iterations[-1]
        yield {
            **{name: row[name] for name in ("robot", "hash", "seed", "outcome")},
            "policy": "last" if last else "first",
            "experiments": int(row["experiments"]) if last else 0,
            "test_episodes": row["test_episodes"].count("1") if last else "",  # of 10
            **scores(law, joint, NOISE),
            "robustness_with_gap": robustness(law, joint, NOISE, changed)["robustness"],
            "performance_with_gap": performance(law, joint, changed(UNDISTURBED)),
        }


def main(out: Path) -> None:
    """Score all trials."""
    trials = results.of_folders(expand(["+sweep=learned_on_their_simulator"], CONF), TRIALS)
    with np.errstate(invalid="ignore"):  # where a robot spins out of all bounds
        rows = [each for row in trials.to_dict("records") for each in scored(row)]
    pd.DataFrame(rows).to_csv(out, index=False, float_format="%.4f", lineterminator="\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
