"""Sine, cosine, arctangent and hyperbolic tangent of compiled code against the mathematics library."""

import numpy as np
from in_lanes import from_python
from numba import njit

from simbias.simulation.compiler.compilation import Compilation
from simbias.simulation.compiler.trigonometry import arctan, sincos, tanh

compiled = Compilation().compiled(sincos)


@njit
def all_of(x):
    out = np.empty((2, x.size))
    for i in range(x.size):
        out[0, i], out[1, i] = compiled(x[i])
    return out


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


def test_what_is_not_finite_is_not_a_number_and_what_is_far_away_stays_finite() -> None:
    """A rollout that blows up has failed before."""
    assert np.isnan(all_of(np.array([np.nan, np.inf, -np.inf, 1e308]))[:, :3]).all()
    assert np.isfinite(all_of(np.array([1e6, -1e7, 1e9]))).all()


def test_arctangent_and_hyperbolic_tangent_agree() -> None:
    for function, numpys, rtol in ((arctan, np.arctan, 1e-15), (tanh, np.tanh, 2e-15)):
        own = from_python(function)
        for size in (1e-300, 1e-8, 0.1, 1.0, 10.0, 1e3, 1e100):
            x = np.linspace(-size, size, 2001)
            np.testing.assert_allclose([own(each) for each in x], numpys(x), rtol=rtol, atol=1e-300)
            np.testing.assert_array_equal(function(x), numpys(x))
        assert np.isnan(own(np.nan))
