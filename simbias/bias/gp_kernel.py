"""The compiled correction of a Gaussian-process bias (Eq. 4, 5 and 7), for several steps at once.

Nearly all of a policy search is spent here: on N^2 / 2 products for the variance of each step. One step alone
is bound by reading the factor from the cache; single precision halves that, the triangle L^-1 halves it again
against K^-1, and steps of several rollouts share one reading. The sum of squares |L^-1 k|^2 has no
cancellation, so the error stays near 1e-6 of the signal variance.
"""

from __future__ import annotations

import numpy as np
from numba import float32, int32, njit, types, void

from simbias.kernels import MATRIX, VECTOR, correction_signature, kernel
from simbias.records import Array

PANEL = 64  # rows of L^-1 that are multiplied together, as wide as the triangle is there

SINGLE = float32[:, ::1]
GP_DATA = types.Tuple((SINGLE, float32[::1], SINGLE, VECTOR, VECTOR))
REORDERED = {"reassoc", "contract", "nsz"}  # lets sums vectorise; nan and inf keep their meaning

LN_2 = np.float32(np.log(2.0))
LOG2_E = np.float32(1.0 / np.log(2.0))
LEAST = np.float32(-87.0)  # exp of less is no normal single-precision number
EXP_SERIES = tuple(np.float32(1.0 / f) for f in (720.0, 120.0, 24.0, 6.0, 2.0, 1.0, 1.0))
EXPONENT_BIAS, MANTISSA_BITS = np.int32(127), np.int32(23)


def packed_panels(L_inverse: Array) -> np.ndarray:
    """The panels of a lower triangle (N, N), one after the other, in single precision."""
    ends = range(PANEL, len(L_inverse) + PANEL, PANEL)
    panels = [L_inverse[end - PANEL : end, : min(end, len(L_inverse))].ravel() for end in ends]
    return np.concatenate([*panels, np.empty(0)]).astype(np.float32)


@njit(void(float32[::1]), cache=True, fastmath=REORDERED)
def exp_of_minus_half(z):
    """exp(-z / 2) of z >= 0 in place, to 1e-6 relative; vectorises, where the library's exp does not."""
    bits = np.empty(z.size, np.int32)
    for j in range(z.size):
        v = max(np.float32(-0.5) * z[j], LEAST)
        n = np.floor(v * LOG2_E + np.float32(0.5))
        remainder = v - n * LN_2
        series = EXP_SERIES[0]
        for coefficient in EXP_SERIES[1:]:
            series = series * remainder + coefficient
        z[j] = series
        bits[j] = (int32(n) + EXPONENT_BIAS) << MANTISSA_BITS
    powers = bits.view(np.float32)  # 2^n
    for j in range(z.size):
        z[j] *= powers[j]


@njit(SINGLE(MATRIX, MATRIX, SINGLE, VECTOR), cache=True, fastmath=REORDERED)
def correlations(x, u, points, inverse_scale):
    """k (a, N) of Eq. 4, over alpha^2: rows for the states x (a, n) under u (a, m)."""
    a, n, N = x.shape[0], x.shape[1], points.shape[1]
    k = np.zeros((a, N), np.float32)
    for b in range(a):
        squared_distance = k[b]
        for i in range(points.shape[0]):
            value = x[b, i] if i < n else u[b, i - n]
            coordinate = np.float32(value * inverse_scale[i])
            for j in range(N):
                difference = points[i, j] - coordinate
                squared_distance[j] += difference * difference
    exp_of_minus_half(k.ravel())
    return k


@njit(float32[::1](float32[::1], SINGLE), cache=True, fastmath=REORDERED)
def squared_norms(panels, k):
    """|L^-1 k|^2 for each row k of k (a, N)."""
    a, N = k.shape
    columns = np.ascontiguousarray(k.T)
    norms = np.zeros(a, np.float32)
    offset = 0
    for first in range(0, N, PANEL):
        last = min(first + PANEL, N)
        size = (last - first) * last
        panel = panels[offset : offset + size].reshape(last - first, last)
        offset += size
        v = np.dot(panel, columns[:last])
        for i in range(last - first):
            for b in range(a):
                norms[b] += v[i, b] * v[i, b]
    return norms


@kernel(correction_signature(GP_DATA), fastmath=REORDERED)
def correct(x, u, data, correction):
    """exp(-d |sigma|^2) times the mean, from (points, panels, weights, 1 / scale, (alpha^2, prior, d n)).

    With d n = 0 it is the mean alone, and costs no panels.
    """
    points, panels, weights, inverse_scale, constants = data
    alpha_squared, prior, d_n = constants[0], constants[1], constants[2]
    k = correlations(x, u, points, inverse_scale)
    mean = np.dot(k, weights)  # Eq. 4, over alpha^2
    norms = squared_norms(panels, k) if d_n > 0.0 else np.zeros(x.shape[0], np.float32)
    for b in range(x.shape[0]):
        variance = prior - alpha_squared**2 * norms[b]  # Eq. 5
        weight = alpha_squared * np.exp(-d_n * variance)
        for i in range(correction.shape[1]):
            correction[b, i] = weight * mean[b, i]  # Eq. 7
