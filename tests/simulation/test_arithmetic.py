"""Arithmetic of compiled code: in lanes as in NumPy, of vectors row by row, as the mathematics library."""

import llvmlite
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from in_lanes import from_python
from numba import njit

from simbias.simulation.compiler import LANES, elementwise, everywhere, exp, load, sincos, store
from simbias.simulation.compiler.compilation import Compilation
from simbias.simulation.compiler.trigonometry import arctan, tanh

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


@pytest.mark.slow
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


def law(x, parameters):
    """Something of all that a kernel may do: sines, square roots, quotients, squares."""
    s, c = sincos(x[0])
    return s / x[1], np.sqrt(x[1]) * c, x[0] * x[0] + parameters[0]


@pytest.mark.filterwarnings("ignore:.* encountered in sqrt")  # said of a robot's state, of many not
@given(arrays(float, 2, elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_a_vector_alone_is_a_row_of_many(x: np.ndarray) -> None:
    """To the last bit, also where it divides by zero or overflows: Python's numbers would raise there."""
    alone = elementwise(law, x, parameters=np.array([0.5]))
    np.testing.assert_array_equal(alone, elementwise(law, x[None], parameters=np.array([0.5]))[0])


compiled = Compilation().compiled(sincos)


@njit
def all_of(x):
    out = np.empty((2, x.size))
    for i in range(x.size):
        out[0, i], out[1, i] = compiled(x[i])
    return out


@pytest.mark.slow
def test_agrees_with_the_library() -> None:
    """Within an ulp and a half; also around the zeros, where the reduction cancels most, or 1e-16 there."""
    zeros = np.arange(-60_000, 60_001) * (np.pi / 2)
    points = [zeros + step * np.spacing(zeros) for step in (0, 1, -1)]
    points += [np.linspace(-size, size, 20_001) for size in (1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e5)]
    for x in (*points, np.random.default_rng(0).uniform(-1e5, 1e5, 100_000)):
        for values, exact in zip(all_of(x), (np.sin(x), np.cos(x)), strict=True):
            np.testing.assert_allclose(values, exact, rtol=1.5 * np.finfo(float).eps, atol=1e-16)
    x = np.array([[0.1, 2.0], [-3.0, 4.0]])
    np.testing.assert_array_equal(sincos(x), (np.sin(x), np.cos(x)))


@pytest.mark.slow
def test_what_is_not_finite_is_not_a_number_and_what_is_far_away_stays_finite() -> None:
    """A rollout that blows up has failed before."""
    assert np.isnan(all_of(np.array([np.nan, np.inf, -np.inf, 1e308]))[:, :3]).all()
    assert np.isfinite(all_of(np.array([1e6, -1e7, 1e9]))).all()


def test_arctangent_and_hyperbolic_tangent_agree() -> None:
    """Also of what is huge or infinite, as a quotient by zero."""
    for function, numpys, rtol in ((arctan, np.arctan, 1e-15), (tanh, np.tanh, 2e-15)):
        own = from_python(function)
        for size in (1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e100, 1e200):
            x = np.append(np.linspace(-size, size, 2001), [np.inf, -np.inf])
            np.testing.assert_allclose([own(each) for each in x], numpys(x), rtol=rtol, atol=1e-300)
            np.testing.assert_array_equal(function(x), numpys(x))
        assert np.isnan(own(np.nan))
