"""Arithmetic in lanes is NumPy's, row by row."""

import llvmlite
import numba
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from in_lanes import from_python
from numba import njit

from simbias.simulation.compiler import LANES, everywhere, exp, load, store

rows = arrays(np.float32, (3, LANES), elements=st.floats(-1e3, 1e3, width=32))


@njit
def combined(a, b, scale):
    """Every operation: (a - b) * scale + a * b."""
    out = np.empty_like(a)
    for row in range(len(a)):
        x, y = load(a, row), load(b, row)
        store(out, row, (x - y) * everywhere(scale) + x * y)
    return out


def exponentials(z):
    """Of every row."""
    out = np.empty_like(z)
    for row in range(len(z)):
        store(out, row, exp(load(z, row)))
    return out


exponentials = from_python(exponentials)


@settings(deadline=None, max_examples=30)  # the first example compiles
@given(rows, rows, st.floats(-10, 10, width=32))
def test_operations_are_numpys(a: np.ndarray, b: np.ndarray, scale: float) -> None:
    exact = (a.astype(float) - b) * scale + a.astype(float) * b
    size = np.abs(a.astype(float) - b) * abs(scale) + np.abs(a.astype(float) * b)
    allowed = 4 * np.finfo(np.float32).eps * size + np.finfo(np.float32).tiny  # products may underflow
    assert (np.abs(combined(a, b, np.float32(scale)) - exact) <= allowed).all()


def test_exponential() -> None:
    z = np.linspace(-40, 0, 100 * LANES).reshape(-1, LANES).astype(np.float32)
    np.testing.assert_allclose(exponentials(z), np.exp(z.astype(np.float64)), rtol=1e-6)
    beyond = np.full((1, LANES), -1e30, np.float32)
    beyond[0, 0] = -np.inf
    least = exponentials(beyond)
    assert (least < 1e-17).all()
    assert (least**2 >= np.finfo(np.float32).smallest_normal).all()  # others take a hundred times as long


def test_it_is_known_to_work_with_these_versions() -> None:
    """It writes LLVM code by interfaces that Numba may change: with others, try, and add them here."""
    versions = tuple(module.__version__.rpartition(".")[0] for module in (numba, llvmlite))
    assert versions in {("0.68", "0.50")}
