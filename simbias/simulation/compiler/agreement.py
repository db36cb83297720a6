"""Whether what was written down gives the numbers of the method that it was traced from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from simbias.core.records import Array
from simbias.simulation.compiler.points import ROWS
from simbias.simulation.compiler.symbols import TraceError

AGREEMENT = 1e-9  # relative, between a traced kernel and the method
FRAMES = 100  # over which a policy with a state is held against its kernel
FARTHEST = 1e3  # state from which a policy begins anew there: of larger angles, sines are those of rounding


def compare(method: Callable, arguments: Sequence[Array], made: Sequence[Sequence[Any]]) -> None:
    """Raise unless the method gives these vectors, the same ones twice, and most of them are finite."""
    first, again = (method(*(each.copy() for each in arguments)) for _ in range(2))
    if len(made) == 1:
        first, again = (first,), (again,)
    for one, other, values in zip(first, again, made, strict=True):
        expected = np.asarray(one, np.float64)
        if not np.array_equal(expected, other, equal_nan=True):
            raise TraceError("it gives other numbers when it is asked again")
        traced = rows(values)
        if expected.shape != traced.shape:
            raise TraceError(f"of {ROWS} rows it gives the shape {expected.shape}, not {traced.shape}")
        if not np.isfinite(expected).all(axis=1).sum() >= ROWS // 2:
            raise TraceError("it gives what is not finite at most states near the start")
        _expect_equal(traced, expected)


def _expect_equal(traced: Array, expected: Array) -> None:
    """Raise unless rows (ROWS, r) agree."""
    size = np.max(np.abs(expected), axis=0, initial=0.0, where=np.isfinite(expected))
    if not np.isclose(traced, expected, AGREEMENT, 1e-3 * AGREEMENT * size, equal_nan=True).all():
        raise TraceError("what was written down gives other numbers")


def compare_frames(act: Callable, traced: Callable, x: Array, state_size: int) -> None:
    """Raise unless policies (ROWS, p) and their kernel, both of (x, t, state), agree in many frames.

    Each frame begins with the state that the policies arrived at: a law may amplify what is rounded. One that
    diverges, as a filter at states that no robot meets, begins anew.
    """
    rng, state = np.random.default_rng(3), np.zeros((ROWS, state_size))
    for frame in range(FRAMES):
        now = x[rng.permutation(ROWS)], 0.01 * frame, state
        u, state = act(*now)
        for values, expected in zip(traced(*now), (u, state), strict=True):
            _expect_equal(rows(values), np.asarray(expected, np.float64))
        state = np.where((np.abs(state) < FARTHEST).all(axis=1, keepdims=True), state, 0.0)


def rows(values: Sequence[Any], count: int = ROWS) -> Array:
    """Rows (count, r) of columns, some of which may be single numbers."""
    filled = np.empty((count, len(values)))
    for index, column in enumerate(values):
        filled[:, index] = column
    return filled
