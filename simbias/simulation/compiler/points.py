"""States and inputs at which a traced kernel is held against its method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from simbias.core import Task
from simbias.core.records import Array

ROWS = 32

Points = Callable[[], tuple[Array, Array]]  # draws states (ROWS, n) and inputs (ROWS, m)


def points_of(task: Task) -> tuple[Array, Array]:
    """Around the start, farther away and at what criteria allow; inputs within, at and beyond limits."""
    rng, n = np.random.default_rng(0), len(task.start_mean)
    near = task.start_deviation * rng.standard_normal((ROWS, n))
    far = rng.standard_normal((ROWS, n)) * np.repeat([0.0, 0.1, 1.0, 0.0], ROWS // 4)[:, None]
    states = task.start_mean + near + far
    for criterion in task.criteria:
        for i, state in enumerate(task.states):
            bound = criterion.bounds.get(state.name, np.nan)
            if np.isfinite(bound):  # in some rows, on either side
                states[i % 4 :: 8, i] = bound * rng.choice([-1.0, 1.0], ROWS // 8)
    limit = np.where(np.isfinite(task.input_limit), task.input_limit, 1.0)
    inputs = 1.2 * limit * rng.uniform(-1, 1, (ROWS, len(limit)))
    for rows, limits in zip((slice(1, None, 8), slice(5, None, 8)), task.input_bounds, strict=True):
        inputs[rows] = np.where(np.isfinite(limits), limits, inputs[rows])
    return states, inputs


def points_among(states: Array, inputs: Array) -> tuple[Array, Array]:
    """Among those of a record, and a little off them."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(states), ROWS)
    off = 1.0 + 0.1 * rng.standard_normal((ROWS, 1))
    return off * states[rows] + 0.01 * (off - 1.0), off * inputs[rows]
