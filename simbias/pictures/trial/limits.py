"""Which of a task's criteria are limits on a state."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from simbias.interfaces import Task
from simbias.records import Array

SAMPLES = 100  # random states on which a criterion is judged,
SCALES = np.log(1e-2), np.log(1e2)  # of all sizes
FARTHEST = 1e6  # where nothing is a limit any more


def state_limits(task: Task) -> Array:
    """The interval (n, 2) that each state must not leave, whatever the others are; infinite without limit.

    A criterion limits the i-th state if the others cannot make up for it: if its measure is never greater at
    x_i alone, all else zero, than at x. That is judged on random states, as a task only tells measures.
    """
    n = len(task.states)
    rng = np.random.default_rng(0)
    samples = np.exp(rng.uniform(*SCALES, (SAMPLES, 1))) * rng.standard_normal((SAMPLES, n))
    measures = np.array([task.measure(x) for x in samples])
    limits = np.tile([-np.inf, np.inf], (n, 1))
    for i in range(n):
        alone = np.array([task.measure(x[i] * np.eye(n)[i]) for x in samples])
        for c in np.flatnonzero((alone <= measures + 1e-9).all(axis=0)).tolist():
            limits[i, 0] = max(limits[i, 0], -_reach(task, c, -np.eye(n)[i]))
            limits[i, 1] = min(limits[i, 1], _reach(task, c, np.eye(n)[i]))
    return limits


def _reach(task: Task, criterion: int, direction: Array) -> float:
    """How far a state can go from zero in a direction (n,) until a criterion's measure is at its limit."""

    def beyond(distance: float) -> float:
        return float(task.measure(distance * direction)[criterion] - task.criteria[criterion].limit)

    if not beyond(0.0) < 0.0 < beyond(FARTHEST):
        return np.inf
    return float(brentq(beyond, 0.0, FARTHEST))
