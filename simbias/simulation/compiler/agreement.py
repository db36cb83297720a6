"""Checks that a traced kernel gives the same numbers as its method, at some points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.records import Array, Indices
from simbias.simulation.compiler.symbols import TraceError

ROWS = 32  # of points
AGREEMENT = 1e-9  # relative, between a traced kernel and the method
FRAMES = 100  # over which a policy with a state is compared with its kernel
OTHERWISE = "its compiled form gives other numbers"
MIXED = "for several rollouts at once it gives other numbers than for each alone"
FARTHEST = 1e3  # beyond this policy state, it is reset: sines of larger angles are mere rounding

Points = Callable[[], tuple[Array, Array]]  # draws states (ROWS, n) and inputs (ROWS, m)


def points_of(task: Task) -> tuple[Array, Array]:
    """States near the start, farther away and at criteria's limits; inputs within, at and beyond limits."""
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
    for some, limits in zip((slice(1, None, 8), slice(5, None, 8)), task.input_bounds, strict=True):
        inputs[some] = np.where(np.isfinite(limits), limits, inputs[some])
    return states, inputs


def points_among(states: Array, inputs: Array) -> tuple[Array, Array]:
    """States and inputs at and near those of a record."""
    rng = np.random.default_rng(0)
    some = rng.integers(0, len(states), ROWS)
    off = 1.0 + 0.1 * rng.standard_normal((ROWS, 1))
    return off * states[some] + 0.01 * (off - 1.0), off * inputs[some]


def compare(method: Callable, arguments: Sequence[Array], made: Sequence[Sequence[Any]]) -> None:
    """Raise unless the method returns these vectors, twice the same, mostly finite."""
    first, again = (method(*(each.copy() for each in arguments)) for _ in range(2))
    if len(made) == 1:
        first, again = (first,), (again,)
    for index, (one, other, values) in enumerate(zip(first, again, made, strict=True)):
        expected = np.asarray(one, np.float64)
        if not np.array_equal(expected, other, equal_nan=True):
            raise TraceError("it gives other numbers when it is called again")
        traced = rows(values)
        if expected.shape != traced.shape:
            raise TraceError(f"for {ROWS} rows it gives the shape {expected.shape}, not {traced.shape}")
        if not np.isfinite(expected).all(axis=1).sum() >= ROWS // 2:
            raise TraceError("its values are not finite at most states near the start")
        if len(wrong := _unlike(traced, expected)):
            row = slice(wrong[0], wrong[0] + 1)
            alone = method(*(each[row].copy() for each in arguments))
            alone = np.asarray(alone if len(made) == 1 else alone[index], np.float64)
            raise TraceError(OTHERWISE if len(_unlike(traced[row], alone)) else MIXED)


def _unlike(traced: Array, expected: Array) -> Indices:
    """Indices of the rows (k, r) that do not agree."""
    size = np.max(np.abs(expected), axis=0, initial=0.0, where=np.isfinite(expected))
    close = np.isclose(traced, expected, AGREEMENT, 1e-3 * AGREEMENT * size, equal_nan=True)
    return np.flatnonzero(~close.all(axis=1))


def compare_frames(act: Callable, traced: Callable, x: Array, state_size: int) -> None:
    """Raise unless policies (ROWS, p) and their kernel, both of (x, t, state), agree in many frames.

    Each frame begins with the state that the policies computed, because a law may amplify rounding errors. A
    diverging state, such as that of a filter at unrealistic states, is reset.
    """
    rng, state = np.random.default_rng(3), np.zeros((ROWS, state_size))
    for frame in range(FRAMES):
        now = x[rng.permutation(ROWS)], 0.01 * frame, state
        u, state = act(*now)
        for values, expected in zip(traced(*now), (u, state), strict=True):
            if len(_unlike(rows(values), np.asarray(expected, np.float64))):
                raise TraceError(OTHERWISE)
        state = np.where((np.abs(state) < FARTHEST).all(axis=1, keepdims=True), state, 0.0)


def rows(values: Sequence[Any], count: int = ROWS) -> Array:
    """Rows (count, r) of columns, some of which may be single numbers."""
    filled = np.empty((count, len(values)))
    for index, column in enumerate(values):
        filled[:, index] = column
    return filled
