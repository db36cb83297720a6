"""Sine, cosine, arctangent and hyperbolic tangent of compiled code against the mathematics library."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from simbias.simulation.compiler import arctan, sincos, tanh
from simbias.simulation.compiler.compilation import Compilation

compiled = Compilation().compiled(sincos)


@njit
def all_of(x):
    out = np.empty((2, x.size))
    for i in range(x.size):
        out[0, i], out[1, i] = compiled(x[i])
    return out


def check(x: np.ndarray) -> None:
    """Within an ulp and a half, or 1e-16 where the value is near zero."""
    for values, exact in zip(all_of(x), (np.sin(x), np.cos(x)), strict=True):
        np.testing.assert_allclose(values, exact, rtol=1.5 * np.finfo(float).eps, atol=1e-16)


@pytest.mark.parametrize("size", [1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e5])
def test_agrees_with_the_library(size: float) -> None:
    check(np.linspace(-size, size, 200_001))


@settings(deadline=None)
@given(st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=50))
def test_agrees_at_awkward_numbers(x: list[float]) -> None:
    check(np.array(x))


def test_agrees_around_the_zeros() -> None:
    """Where the reduction cancels most."""
    zeros = np.arange(-60_000, 60_001) * (np.pi / 2)
    for step in (0, 1, -1):
        check(zeros + step * np.spacing(zeros))


def test_what_is_not_finite_is_not_a_number() -> None:
    assert np.isnan(all_of(np.array([np.nan, np.inf, -np.inf, 1e308]))[:, :3]).all()


def test_far_away_nothing_is_raised_and_the_size_stays() -> None:
    """A rollout that blows up has failed before."""
    values = all_of(np.array([1e6, -1e7, 1e9]))
    assert np.isfinite(values).all()


def test_in_numpy_it_is_numpys() -> None:
    x = np.array([[0.1, 2.0], [-3.0, 4.0]])
    np.testing.assert_array_equal(sincos(x), (np.sin(x), np.cos(x)))


def elementwise(function):
    """The compiled function of an array."""
    compiled = Compilation().compiled(function)

    @njit
    def of(x):
        out = np.empty(x.size)
        for i in range(x.size):
            out[i] = compiled(x[i])
        return out

    return of


arctans_of, tanhs_of = elementwise(arctan), elementwise(tanh)


@pytest.mark.parametrize("size", [1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e100])
def test_arctangent_agrees_with_the_library(size: float) -> None:
    x = np.linspace(-size, size, 20_001)
    np.testing.assert_allclose(arctans_of(x), np.arctan(x), rtol=1e-15, atol=1e-300)
    np.testing.assert_array_equal(arctan(x), np.arctan(x))


@pytest.mark.parametrize("size", [1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e100])
def test_hyperbolic_tangent_agrees_with_the_library(size: float) -> None:
    x = np.linspace(-size, size, 20_001)
    np.testing.assert_allclose(tanhs_of(x), np.tanh(x), rtol=2e-15, atol=1e-300)
    np.testing.assert_array_equal(tanh(x), np.tanh(x))
    assert np.isnan(tanhs_of(np.array([np.nan, np.inf]))).all()
