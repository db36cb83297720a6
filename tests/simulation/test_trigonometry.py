"""Sine, cosine, arctangent and hyperbolic tangent of compiled code against the mathematics library."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from simbias.core.records import Array
from simbias.simulation.compiler import arctan, sincos, tanh
from simbias.simulation.compiler.compilation import Compilation

compiled = Compilation().compiled(sincos)


@njit
def all_of(x):
    out = np.empty((2, x.size))
    for i in range(x.size):
        out[0, i], out[1, i] = compiled(x[i])
    return out


def check(x: Array) -> None:
    """Within an ulp and a half, or 1e-16 where the value is near zero."""
    for values, exact in zip(all_of(x), (np.sin(x), np.cos(x)), strict=True):
        np.testing.assert_allclose(values, exact, rtol=1.5 * np.finfo(float).eps, atol=1e-16)


def test_agrees_with_the_library() -> None:
    """Also around the zeros, where the reduction cancels most; in NumPy it is NumPy's."""
    for size in (1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e5):
        check(np.linspace(-size, size, 20_001))
    zeros = np.arange(-60_000, 60_001) * (np.pi / 2)
    for step in (0, 1, -1):
        check(zeros + step * np.spacing(zeros))
    x = np.array([[0.1, 2.0], [-3.0, 4.0]])
    np.testing.assert_array_equal(sincos(x), (np.sin(x), np.cos(x)))


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=50))
def test_agrees_at_awkward_numbers(x: list[float]) -> None:
    check(np.array(x))


def test_what_is_not_finite_is_not_a_number_and_what_is_far_away_stays_finite() -> None:
    """A rollout that blows up has failed before."""
    assert np.isnan(all_of(np.array([np.nan, np.inf, -np.inf, 1e308]))[:, :3]).all()
    assert np.isfinite(all_of(np.array([1e6, -1e7, 1e9]))).all()


@pytest.mark.parametrize(("function", "numpys", "rtol"), [(arctan, np.arctan, 1e-15), (tanh, np.tanh, 2e-15)])
def test_arctangent_and_hyperbolic_tangent_agree(function: Callable, numpys: Callable, rtol: float) -> None:
    own = Compilation().compiled(function)

    @njit
    def elementwise(x):
        out = np.empty(x.size)
        for i in range(x.size):
            out[i] = own(x[i])
        return out

    for size in (1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e100):
        x = np.linspace(-size, size, 2001)
        np.testing.assert_allclose(elementwise(x), numpys(x), rtol=rtol, atol=1e-300)
        np.testing.assert_array_equal(function(x), numpys(x))
    assert np.isnan(elementwise(np.array([np.nan]))).all()
