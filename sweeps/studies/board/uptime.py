"""Continue the search of a trial of the board's swing-ups from its last policy, for uptime.

    python sweeps/studies/board/uptime.py acrobot TRIAL INTO [--rounds 3] [override ...]

Its network may have more units, as by policy.units=16. A search begins where the board's resets leave the
robot, and at rest below. Where they leave it depends on the policy, so there are rounds. Each is a preset in
INTO/conf, and a trial in INTO, whose last policy `score.py` scores; resets here have other seeds than there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rollouts import HEIGHT, LENGTHS
from score import DRIVEN, Asked, uptime

import simbias
from simbias.core.records import Array
from simbias.trial.run import run_trial
from simbias.trial.study import Study

SEEDS, SHOWN = range(100, 140), range(200, 220)  # of resets: those to begin after, and those that are printed
HANGING = 0.1  # of the starts
SPREADS = {"angle_1": 0.1, "angle_2": 0.1, "d_angle_1": 0.3, "d_angle_2": 0.5}  # rad, rad/s, about each start
UP = "length_1 * cos(angle_1) + length_2 * cos(angle_1 + angle_2) - high"  # m, of the tip
NEAR = "exp(cos(angle_1) + cos(angle_2) - 2 - (d_angle_1**2 + d_angle_2**2) / (2 * fast**2))"
COST = {  # of the time below, and a little, of how far it is from upright and at rest
    "running": f"1 / (1 + exp(({UP}) / blur)) + near * (1 - {NEAR})",
    "constants": {"length_1": LENGTHS[0], "length_2": LENGTHS[1], "high": HEIGHT}
    | {"blur": 0.02, "near": 0.2, "fast": 15.0},
    "max_cost": 1.2,
    "failure_weight": 1.3,
}
FASTEST = 300.0  # rad/s: a policy that lets the elbow spin has to slow it down


def begins(law: Asked, joint: int) -> list[list[float]]:
    """Starts, of which the first angle is 0 upright: after resets, and at rest below."""
    after: list[Array] = []
    uptime(law, joint, SEEDS, after)
    states = np.array(after) - [np.pi, 0.0, 0.0, 0.0]
    states = states[(np.abs(states[:, 2:]) < FASTEST).all(axis=1)]
    states[:, :2] = (states[:, :2] + np.pi) % (2 * np.pi) - np.pi
    hanging = round(HANGING * len(states)) * [[np.pi, 0.0, 0.0, 0.0]]
    return [*states.round(4).tolist(), *hanging]


def preset(robot: str, law: Asked, policy: Path) -> dict[str, Any]:
    """A round's config: as the board's, from these starts and this policy on."""
    spreads = {name: {"mean": 0.0, "uniform": None, "deviation": each} for name, each in SPREADS.items()}
    return {
        "defaults": [f"{robot}_board", {"override /cost": "declared"}, "_self_"],
        "cost": COST,
        "task": {
            "starts": begins(law, DRIVEN.index(robot)),
            "states": spreads,
            "failure": {"speed": {"above": FASTEST}},
        },
        "method": {"first_policy": str(policy.resolve())},
    }


def grown(parameters: Array, study: Study) -> Array:
    """Parameters for a study whose network may have more units: the others do nothing at first."""
    q, more = len(study.task.outputs), study.policy.n_parameters - len(parameters)
    units, added = (len(parameters) - 2) // (q + 2), more // (q + 2)
    weights, rest = parameters[: units * (q + 2)], parameters[units * (q + 2) :]
    W_1, b_1, W_2 = np.split(weights, [units * q, units * (q + 1)])
    new = np.random.default_rng(0).normal(0.0, 0.5, added * (q + 1))
    return np.concatenate([W_1, new[: added * q], b_1, new[added * q :], W_2, np.zeros(added), rest])


def law_of(study: Study, parameters: Array) -> Asked:
    """A policy as their loop asks it."""
    return Asked(study.policy, study.task, parameters)


def main() -> None:
    """Run the rounds, and print how long the tip is up after each."""
    parser = argparse.ArgumentParser(prog="uptime", description=__doc__.splitlines()[0])
    parser.add_argument("robot", choices=DRIVEN)
    parser.add_argument("trial", type=Path)
    parser.add_argument("into", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="override")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_intermixed_args()
    presets, trial = arguments.into / "conf" / "preset", simbias.load_trial(arguments.trial)
    presets.mkdir(parents=True, exist_ok=True)
    study, parameters = trial.study, trial.iterations[-1].parameters
    for index in range(1, arguments.rounds + 1):
        policy = presets.parent / f"policy_{index}.json"
        content = preset(arguments.robot, law_of(study, parameters), policy)
        text = f"# @package _global_\n{yaml.safe_dump(content, sort_keys=False, default_flow_style=None)}"
        (presets / f"round_{index}.yaml").write_text(text)
        study = simbias.load([f"preset=round_{index}", *arguments.overrides], presets.parent)
        policy.write_text(json.dumps({"parameters": grown(parameters, study).tolist()}))
        folder = arguments.into / f"round_{index}"
        parameters = run_trial(study, folder).iterations[-1].parameters
        shares = uptime(law_of(study, parameters), DRIVEN.index(arguments.robot), SHOWN)
        print(f"{folder}: up for {shares.mean():.3f} ({shares.min():.3f} to {shares.max():.3f})", flush=True)


if __name__ == "__main__":
    main()
