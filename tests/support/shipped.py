"""Which shipped options belong to which robot, so that tests can choose them together."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import yaml

from simbias.config import compose, options
from simbias.config.components import TARGET
from simbias.config.resources import resource_folder

OF_A_ROBOT = ("task", "nominal", "hardware", "samples", "cost")
GROUPS = (  # whose options go through the conformance suite; robots have theirs in tests/robots
    *("policy", "bias", "samples", "cost", "evaluation", "identification", "optimizer"),
)
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
    "nominal=mujoco": ["preset=cartpole", f"nominal.file={MODEL}"],
}


def overrides(group: str, option: str) -> list[str]:
    """What chooses a shipped option, and what it needs besides."""
    choice = f"{group}={option}"
    if choice in NEEDED:
        return [choice, *NEEDED[choice]]
    preset = _presets().get((group, option))
    return [f"preset={preset}", *NEEDED.get(f"preset={preset}", [])] if preset else [choice]


def file_of(group: str, option: str) -> Any:
    """What a shipped option's file says."""
    return yaml.safe_load((resource_folder("conf") / group / f"{option}.yaml").read_text())


def shipped(group: str, option: str) -> Any:
    """What names the class of an option: its file, or what that is composed with."""
    own = file_of(group, option)
    return own if TARGET in own and "defaults" not in own else compose(overrides(group, option)).config[group]


@cache
def _presets() -> dict[tuple[str, str], str]:
    """The first preset that chooses an option of a robot, or is named as it; not of the default's."""
    default, found = compose([]).choices, dict[tuple[str, str], str]()
    for preset in options()["preset"]:
        for group, option in compose([f"preset={preset}"]).choices.items():
            if (group in OF_A_ROBOT or option == preset) and option != default[group]:
                found.setdefault((group, option), preset)
    return found
