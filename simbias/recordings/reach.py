"""How far recordings reach beyond what a model was learned from.

A region is scaled by errors on what was learned from. Where a robot stands elsewhere, moves faster or is
pushed harder, these errors tell little (`sweeps/results/rigs/HOW.md`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from simbias.core import Task
from simbias.core.quantities import wrapped
from simbias.core.records import Array, Rollout

ENDS = (0.0025, 0.9975)  # quantiles that count as the ends of a range: single frames do not
MARGIN = 0.1  # of a range's width, at each end
WORTH_TELLING = 0.15  # share of frames


class Reach(NamedTuple):
    """A state or an input that leaves the range that a model was learned from."""

    name: str
    unit: str
    range: tuple[float, float]
    learned: tuple[float, float]  # its range in what was learned from
    share: float  # of frames in which it is beyond


def beyond(task: Task, rollouts: Sequence[Rollout], learned: Sequence[Rollout]) -> list[Reach]:
    """States and inputs of rollouts that reach beyond those that were learned from, the most often first.

    An angle that wraps is told within half a turn of the middle of what was learned from.
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
