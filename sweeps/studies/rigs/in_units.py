"""Errors in units, as others publish theirs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from loading import Rig, cases
from ways import Learned, identified, lab, nominal

from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.simulation.open_loop import PredictionModel, Windows, predict

COMPARED = {"nominal": nominal, "lab": lab, "identified": identified}


def rows(rig: Rig, published: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Errors of a state in each case, root mean square and median, beside the published one.

    They are those after `seconds`, or of simulations of whole recordings where none are told.
    """
    place = [state.name for state in rig.study.task.states].index(published["state"])
    for number, name, known, left in cases(rig):
        for way, learn in COMPARED.items():
            found = learn(rig, list(known.values()))
            if "seconds" in published:
                wrong = found.errors(left, rig.study.task.frames(published["seconds"]))
            else:
                wrong = np.concatenate([simulated(found, rollout) for rollout in left])
            size = np.abs(wrong[:, place])
            errors = {"rmse": np.sqrt(np.mean(size**2)), "median": np.median(size)}
            told = {"published": published["error"], "parameters": _parameters(found)}
            yield {"number": number, "learned": name, "way": way, "state": published["state"]} | errors | told


def simulated(found: Learned, rollout: Rollout) -> Array:
    """Errors (k, n) in each frame of a simulation of a whole recording from its first state."""
    windows = Windows.of([rollout], rollout.frames, 1)
    return (predict([PredictionModel(found.model)], windows, found.bias)[0] - windows.means)[0]


def _parameters(found: Learned) -> str:
    """What was identified, with 90% intervals."""
    if not isinstance(found.model, Identified):
        return ""
    return "; ".join(f"{e.name} {e.value:.4g} ({e.low:.4g} to {e.high:.4g})" for e in found.model.estimates)
