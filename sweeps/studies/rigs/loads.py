"""A load that is put on a robot, weighed by its recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from loading import Rig
from ways import fit

from simbias.core.records import Rollout
from simbias.learning.identification.identified import Identified, Known


def rows(rig: Rig, load: str, unloaded: Rig) -> Iterator[dict[str, Any]]:
    """The load by its 5%, 50% and 95% quantiles, of what each recording without it, and all of them, tell."""
    before = {name: [rollout] for name, rollout in unloaded.development.items()}
    before |= {"all": list(unloaded.development.values())}
    for name, rollouts in before.items():
        yield {"load": load, "learned": name} | _weighed(rig, load, fit(unloaded, rollouts))


def _weighed(rig: Rig, load: str, known: Identified) -> dict[str, float]:
    """The load, where the robot without it is known."""
    loaded: Sequence[Rollout] = list((rig.test or rig.development).values())
    (found,) = (
        each
        for each in fit(rig, loaded, _with_prior(rig, known.elsewhere().known)).estimates
        if each.name == load
    )
    return {"low": found.low, "value": found.value, "high": found.high}


def _with_prior(rig: Rig, known: Known) -> Known:
    """What is known, and the priors of what the rig has besides."""
    names = [parameter.name for parameter in rig.prior.parameters]
    places = [names.index(name) for name in known.parameters]
    mode, spread = np.zeros(len(names)), np.eye(len(names))
    mode[places], spread[np.ix_(places, places)] = known.mode, known.spread
    return Known(names, mode.tolist(), spread.tolist())
