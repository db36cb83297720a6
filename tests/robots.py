"""Which shipped options belong to which robot, so that tests can choose them together."""

from __future__ import annotations

from functools import cache

from simbias.config import compose, options

OF_A_ROBOT = ("task", "nominal", "hardware", "samples", "cost")
MODEL = "gymnasium:envs/mujoco/assets/inverted_pendulum.xml"
NEEDED = {  # by options that say nothing of a robot
    "hardware=gymnasium": [
        "preset=cartpole",
        "hardware.environment=InvertedPendulum-v5",
        "hardware.action=[force/100]",
    ],
    "hardware=process": ["hardware.command=cat"],
    "hardware=mujoco": ["preset=cartpole", f"hardware.file={MODEL}"],
    "nominal=mujoco": ["preset=cartpole", f"nominal.file={MODEL}"],
}


def overrides(group: str, option: str) -> list[str]:
    """What chooses a shipped option, and what it needs besides."""
    choice = f"{group}={option}"
    if choice in NEEDED:
        return [choice, *NEEDED[choice]]
    preset = _presets().get((group, option))
    return [f"preset={preset}"] if preset else [choice]


@cache
def _presets() -> dict[tuple[str, str], str]:
    """The first preset that chooses an option of a robot, but for options that the default chooses."""
    default, found = compose([]).choices, dict[tuple[str, str], str]()
    for preset in options()["preset"]:
        for group, option in compose([f"preset={preset}"]).choices.items():
            if group in OF_A_ROBOT and option != default[group]:
                found.setdefault((group, option), preset)
    return found
