"""Sine, cosine, arctangent and hyperbolic tangent for compiled code, in the lanes of vector registers.

The mathematics library takes one number at a time, which would prevent vectorising the whole closed loop.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from simbias.core.records import Array
from simbias.simulation.compiler.compilation import compiled_as

# pi / 2 in three parts; the first two have 33 bits, so that their products with k < 2^20 are exact.
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
# Minimax polynomials on [-pi/4, pi/4] (FreeBSD's msun, k_sin.c and k_cos.c).
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def _by_polynomials(x: float) -> tuple[float, float]:
    """Sine and cosine of x, without branches: to 2e-16 for |x| <= 1e6; non-finite x gives nan."""
    k = np.floor(x * (2 / np.pi) + 0.5)
    r = x - k * _HALF_PI[0] - k * _HALF_PI[1] - k * _HALF_PI[2]
    z = r * r
    s5 = _SINE[4] + z * _SINE[5]
    s = r + r * z * (_SINE[0] + z * (_SINE[1] + z * (_SINE[2] + z * (_SINE[3] + z * s5))))
    c5 = _COSINE[4] + z * _COSINE[5]
    c = 1.0 - 0.5 * z + z * z * (_COSINE[0] + z * (_COSINE[1] + z * (_COSINE[2] + z * (_COSINE[3] + z * c5))))
    half = np.floor(0.5 * k)
    odd = k - 2.0 * half  # 1 in every other quadrant, where sine and cosine swap
    sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))  # of the sine: -1 in the third and fourth quadrant
    even = 1.0 - odd
    return sign * (odd * c + even * s), sign * (even - odd) * (odd * s + even * c)


@compiled_as(_by_polynomials)
def sincos(x: Any) -> tuple[Any, Any]:
    """Sine and cosine of x, a number or an array."""
    if isinstance(x, float):  # arithmetic with Python's numbers is faster than with NumPy's
        if not math.isfinite(x):
            return math.nan, math.nan
        return float(np.sin(x)), float(np.cos(x))
    return np.sin(x), np.cos(x)


def _by_halving(x: float) -> float:
    """Arctangent of x, without branches: to 1e-15."""
    x = min(max(x, -1e150), 1e150)  # beyond, the result is the same, but the square may overflow
    y = x / (1.0 + np.sqrt(1.0 + x * x))  # tan(a / 2), where tan(a) = x
    y = y / (1.0 + np.sqrt(1.0 + y * y))
    y = y / (1.0 + np.sqrt(1.0 + y * y))  # |y| <= tan(pi / 16)
    z = y * y
    tail = 1 / 9 - z * (1 / 11 - z * (1 / 13 - z * (1 / 15 - z * (1 / 17 - z * (1 / 19 - z / 21)))))
    return 8.0 * y * (1.0 - z * (1 / 3 - z * (1 / 5 - z * (1 / 7 - z * tail))))


@compiled_as(_by_halving)
def arctan(x: Array) -> Array:
    """Arctangent of x, a number or an array."""
    return np.arctan(x)


def _by_doubling(x: float) -> float:
    """Hyperbolic tangent of x, without branches: to 1e-15."""
    y = min(max(x, -20.0), 20.0) / 64.0
    z = y * y
    n = y * (1.0 + z * (17325.0 + z * (378.0 + z)) / 135135.0)  # n / d: a convergent of a continued fraction
    d = 1.0 + z * (62370.0 + z * (3150.0 + 28.0 * z)) / 135135.0
    n, d = 2.0 * n * d, n * n + d * d  # for 2 y, and so on to 64 y
    n, d = 2.0 * n * d, n * n + d * d
    n, d = 2.0 * n * d, n * n + d * d
    n, d = 2.0 * n * d, n * n + d * d
    n, d = 2.0 * n * d, n * n + d * d
    n, d = 2.0 * n * d, n * n + d * d
    return n / d


@compiled_as(_by_doubling)
def tanh(x: Array) -> Array:
    """Hyperbolic tangent of x, a number or an array."""
    return np.tanh(x)
