"""The robot's model, and what its recordings tell of it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rollouts import COMMANDS, STATES

from simbias.core import Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified

sys.path.append(str(Path(__file__).parent.parent / "rigs"))
from loading import Rig, declared, load


def robot(board: dict[str, Any], checkouts: Path) -> Rig:
    """The robot, with uncertain motors."""
    motors = [
        f"+identification.motors.tau{joint}.{key}={value}"
        for joint in (1, 2)
        for key, value in board["motors"].items()
    ]
    rig = declared()["design_C.1"]
    return load(
        rig
        | {
            "development": [],
            "composition": [*rig["composition"], *motors, "identification.longer_windows=null"],
        },
        checkouts,
    )


def recordings(board: dict[str, Any], checkouts: Path) -> list[Rollout]:
    """What is learned from: states under commands."""
    found = []
    for file in board["recordings"]["files"]:
        table = pd.read_csv(checkouts / board["recordings"]["folder"] / file)
        states = table[STATES].to_numpy()[1:]  # of a row: measured when the command of the last was given
        commands = table[COMMANDS].to_numpy()[:-2]
        found.append(Rollout(states, commands, measured=states, sensed=True))
    return found


def draws(rig: Rig, known: Sequence[Rollout], zero: float, count: int, rng: np.random.Generator) -> Array:
    """Parameters (p, count) of kernels of models from the posterior, with zeros like those identified."""
    fitted = rig.study.identification.fit(rig.study.nominal, known)
    assert isinstance(fitted, Identified)
    each = [fitted.of_recording(index).estimates for index in range(len(known))]
    zeros = np.array([[e.value for e in own if e.name.endswith(".zero")] for own in each])
    model, own = fitted.elsewhere(), [parameter.of_recording for parameter in fitted.parameters]
    z = model.mode[:, None] + model.spread @ rng.standard_normal((model.spread.shape[1], count))
    z[own] *= np.sqrt(np.mean(zeros**2, axis=0))[:, None] / zero
    return np.stack([numbers(model.at(coordinates)) for coordinates in z.T], axis=1)


def angle_noise(known: Sequence[Rollout]) -> Array:
    """Standard deviations (2,) of white noise in recorded angles, from their third differences."""
    thirds = np.concatenate([np.diff(rollout.states[:, :2], 3, axis=0) for rollout in known])
    deviations: Array = np.sqrt(np.mean(thirds**2, axis=0) / 20.0)
    return deviations


def numbers(model: Nominal) -> Array:
    """The parameters (p,) of a model's kernel."""
    assert model.kernel is not None
    return np.asarray(model.kernel.parameters)
