"""Arithmetic in lanes is NumPy's, row by row."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit

from simbias.simulation.lanes import WIDTH, everywhere, exp, loaded, stored

rows = arrays(np.float32, (3, WIDTH), elements=st.floats(-1e3, 1e3, width=32))


@njit
def combined(a, b, scale):
    """Every operation: (a - b) * scale + a * b."""
    out = np.empty_like(a)
    for row in range(len(a)):
        x, y = loaded(a, row), loaded(b, row)
        stored(out, row, (x - y) * everywhere(scale) + x * y)
    return out


@njit
def exponentials(z):
    """Of every row."""
    out = np.empty_like(z)
    for row in range(len(z)):
        stored(out, row, exp(loaded(z, row)))
    return out


@settings(deadline=None)  # the first example compiles
@given(rows, rows, st.floats(-10, 10, width=32))
def test_operations_are_numpys(a: np.ndarray, b: np.ndarray, scale: float) -> None:
    exact = (a.astype(float) - b) * scale + a.astype(float) * b
    size = np.abs(a.astype(float) - b) * abs(scale) + np.abs(a.astype(float) * b)
    allowed = 4 * np.finfo(np.float32).eps * size + np.finfo(np.float32).tiny  # products may underflow
    assert (np.abs(combined(a, b, np.float32(scale)) - exact) <= allowed).all()


def test_exponential() -> None:
    z = np.linspace(-87, 0, 100 * WIDTH).reshape(-1, WIDTH).astype(np.float32)
    np.testing.assert_allclose(exponentials(z), np.exp(z.astype(np.float64)), rtol=1e-6)
    beyond = np.full((1, WIDTH), -1e30, np.float32)
    beyond[0, 0] = -np.inf
    assert (exponentials(beyond) < 2e-38).all()
    assert (exponentials(beyond) >= 0).all()


def test_lanes_do_not_mix_with_numbers() -> None:
    @njit
    def wrong(a):
        return loaded(a, 0) + 1.0

    with pytest.raises(Exception, match="No implementation of function"):
        wrong(np.ones((1, WIDTH), np.float32))
