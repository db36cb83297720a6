"""How far recordings extend beyond a model's training data.

Regions are scaled by errors on training data. If a robot is elsewhere, moves faster or is pushed harder,
these errors are a poor guide (`sweeps/results/rigs/HOW.md`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simbias.core import Task
from simbias.core.quantities import wrapped
from simbias.core.records import Array, Rollout

ENDS = (0.0025, 0.9975)  # quantiles used as the ends of a range, to ignore single frames
MARGIN = 0.1  # of a range's width, at each end
WORTH_TELLING = 0.15  # share of frames


class Reach(NamedTuple):
    """A state or an input that leaves the range of a model's training data."""

    name: str
    unit: str
    range: tuple[float, float]
    learned: tuple[float, float]  # its range in the training data
    share: float  # share of frames beyond this range


def beyond(task: Task, rollouts: Sequence[Rollout], learned: Sequence[Rollout]) -> list[Reach]:
    """States and inputs of rollouts outside the range of the `learned` rollouts, most frequent first.

    An angle that wraps is unwound to within half a turn of the middle of the training data.
    """
    quantities = [*task.states, *task.inputs]
    known = np.quantile(_frames(learned), ENDS, axis=0)
    middle = known.mean(axis=0)
    here = middle + wrapped(_frames(rollouts) - middle, quantities)
    ranges = np.quantile(here, ENDS, axis=0)
    margin = MARGIN * (known[1] - known[0])
    shares = np.mean((here < known[0] - margin) | (here > known[1] + margin), axis=0)
    found = [
        Reach(each.name, each.unit, (ranges[0, i], ranges[1, i]), (known[0, i], known[1, i]), shares[i])
        for i, each in enumerate(quantities)
        if shares[i] > WORTH_TELLING
    ]
    return sorted(found, key=lambda each: -each.share)


def _frames(rollouts: Sequence[Rollout]) -> Array:
    """States and inputs (F, n + m) of all frames."""
    return np.concatenate([np.column_stack([each.states[:-1], each.inputs]) for each in rollouts])
