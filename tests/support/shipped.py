"""Shipped options and sweeps: which belong to which robot, and how they are run in little time."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf

from simbias.config import Composition, compose, options
from simbias.config.resources import resource_folder

OF_A_ROBOT = ("task", "nominal", "hardware", "samples", "cost")
# whose options go through the conformance suite
GROUPS = ("policy", "bias", "samples", "cost", "evaluation", "identification", "optimizer")
MODEL = "gymnasium:envs/mujoco/assets/inverted_pendulum.xml"
COLUMNS = (  # of tests/recordings
    "hardware.columns={pos1:pos_meas1,pos2:pos_meas2,vel1:vel_meas1,vel2:vel_meas2,"
    "tau1:tau_meas1,tau2:tau_meas2}"
)
NEEDED = {  # by options that say nothing of a robot
    "hardware=gymnasium": [
        "preset=cartpole",
        "hardware.environment=InvertedPendulum-v5",
        "hardware.action=[force/100]",
    ],
    "preset=double_pendulum": [f"hardware.folder={Path(__file__).parents[1] / 'recordings'}", COLUMNS],
    **{f"preset={name}": ["task.hold=1.0"] for name in ("arm_eight", "quadrotor_square")},  # tests are short
    "hardware=process": ["hardware.command=cat"],
    "hardware=mujoco": ["preset=cartpole", f"hardware.file={MODEL}"],
    "method=trajectory": ["preset=cartpole_trajectory"],
    "preset=near_plan": ["policy=trajectory", "method=trajectory"],
    "nominal=mujoco": ["preset=cartpole", f"nominal.file={MODEL}"],
}
SHORT: dict[str, dict[str, Any]] = {  # at most
    "task": {"horizon": 20, "hold": 0.05},
    "policy": {"knots": 11},
    "evaluation": {"seconds": 0.02, "rollouts": 3},
    "optimizer": {"max_evaluations": 5, "explorations": 5},
    "identification": {"starts": 1, "rounds": 1, "evaluations": 1},
    "method": {
        "max_iterations": 1,
        "retry_search": 0,
        "passes": 2,
        "confidence": 0.2,
        "lqr_candidates": 1,
        "trajectories": 1,
    },
    "policy_test": {"episodes": 1, "long_episodes": 0},
}


def shortened(composition: Composition, seconds: float = 0.0) -> Composition:
    """With no more of anything than SHORT says, but so many seconds of an experiment."""
    config = {key: dict(value) if key in SHORT else value for key, value in composition.config.items()}
    frames = max(SHORT["task"]["horizon"], round(seconds / config["task"]["time_step"]))
    for group, most in (SHORT | {"task": SHORT["task"] | {"horizon": frames}}).items():
        for key in most.keys() & config.get(group, {}).keys():
            if config[group][key] is not None:
                config[group][key] = min(config[group][key], most[key])
    return replace(composition, config=config)


def overrides(group: str, option: str) -> list[str]:
    """What chooses a shipped option, and what it needs besides."""
    choice = f"{group}={option}"
    if choice in NEEDED:
        return [choice, *NEEDED[choice]]
    preset = _presets().get((group, option))
    return [f"preset={preset}", *NEEDED.get(f"preset={preset}", [])] if preset else [choice]


@cache
def file_of(group: str, option: str) -> Any:
    """What a shipped option's file says, which is only read."""
    return yaml.safe_load((resource_folder("conf") / group / f"{option}.yaml").read_text())


def shipped(group: str, option: str) -> Any:
    """What an option's file says, and those that it begins with; interpolations are not resolved."""
    own = dict(file_of(group, option))
    first = [shipped(group, each) for each in own.pop("defaults", []) if each != "_self_"]
    return OmegaConf.to_container(OmegaConf.merge(*first, own))


@cache
def _presets() -> dict[tuple[str, str], str]:
    """The first preset that chooses an option of a robot, or is named as it; not of the default's."""
    default, found = compose([]).choices, dict[tuple[str, str], str]()
    for preset in options()["preset"]:
        for group, option in _chosen(preset).items():
            if (group in OF_A_ROBOT or option == preset) and option != default[group]:
                found.setdefault((group, option), preset)
    return found


def _chosen(preset: str) -> dict[str, str]:
    """The options that a preset's file chooses, and those that it begins with."""
    chosen: dict[str, str] = {}
    for each in file_of("preset", preset).get("defaults", []):
        if isinstance(each, dict):
            chosen |= {key.removeprefix("override /"): option for key, option in each.items()}
        elif each != "_self_":
            chosen |= _chosen(each)
    return chosen
