"""The compiled correction of a Gaussian-process bias (Eq. 4, 5 and 7), for several steps at once.

Most of a policy search is spent here: on N^2 / 2 products for the variance of each step. One step alone is
bound by reading the factor from the cache; single precision halves that, the triangle L^-1 halves it again
against K^-1, and the rollouts that run in step, one in each lane, share one reading. The sum of squares
|L^-1 k|^2 has no cancellation, so the error stays near 1e-6 of the signal variance.
"""

from __future__ import annotations

import numpy as np
from numba import float32, int64, njit, types

from simbias.kernels import VECTOR, correction_signature, kernel
from simbias.lanes import WIDTH, everywhere, exp, loaded, stored
from simbias.records import Array

PANEL = 6  # rows that are multiplied together; with 16 lanes they fill the registers of AVX2

SINGLE = float32[:, ::1]
GP_DATA = types.Tuple((SINGLE, float32[::1], float32[::1], int64, VECTOR, VECTOR))


def packed_triangle(U: Array) -> np.ndarray:
    """The panels of a lower triangle (N, N), one after the other, each as wide as it has to be."""
    N = len(U)
    ends = range(PANEL, N + PANEL, PANEL)
    return _packed([U[end - PANEL : end, : min(end, N)] for end in ends])


def packed(M: Array) -> np.ndarray:
    """The panels of a matrix (k, N), one after the other."""
    return _packed([M[first : first + PANEL] for first in range(0, len(M), PANEL)])


def _packed(panels: list[Array]) -> np.ndarray:
    """Columns follow each other, of PANEL rows each; what is missing of the last panel is zero."""
    filled = [np.pad(panel, ((0, PANEL - len(panel)), (0, 0))) for panel in panels]
    return np.concatenate([*(panel.T.ravel() for panel in filled), np.empty(0)]).astype(np.float32)


@njit
def product(panels, offset, columns, k):
    """The PANEL rows of the panel at this offset, times as many rows of k (N, WIDTH) as it has columns."""
    v0 = v1 = v2 = v3 = v4 = v5 = everywhere(np.float32(0.0))
    for j in range(columns):
        k_j = loaded(k, j)
        v0 = v0 + everywhere(panels[offset]) * k_j
        v1 = v1 + everywhere(panels[offset + 1]) * k_j
        v2 = v2 + everywhere(panels[offset + 2]) * k_j
        v3 = v3 + everywhere(panels[offset + 3]) * k_j
        v4 = v4 + everywhere(panels[offset + 4]) * k_j
        v5 = v5 + everywhere(panels[offset + 5]) * k_j
        offset += PANEL
    return v0, v1, v2, v3, v4, v5


@njit
def correlations(x, u, points, inverse_scale):
    """k (N, WIDTH) of Eq. 4, over alpha^2: columns for the states x (a, n) under u (a, m), a <= WIDTH."""
    a, n = x.shape
    N, r = points.shape
    coordinates = np.zeros((r, WIDTH), np.float32)
    for b in range(a):
        for i in range(r):
            coordinates[i, b] = inverse_scale[i] * (x[b, i] if i < n else u[b, i - n])
    k = np.empty((N, WIDTH), np.float32)
    for j in range(N):
        squared_distance = everywhere(np.float32(0.0))
        for i in range(r):
            difference = loaded(coordinates, i) - everywhere(points[j, i])
            squared_distance = squared_distance + difference * difference
        stored(k, j, exp(everywhere(np.float32(-0.5)) * squared_distance))
    return k


@njit
def squared_norms(triangle, k):
    """|U k|^2 (1, WIDTH) for each column k of k (N, WIDTH)."""
    N = k.shape[0]
    sums = everywhere(np.float32(0.0))
    offset = 0
    for first in range(0, N, PANEL):
        columns = min(first + PANEL, N)
        for v in product(triangle, offset, columns, k):
            sums = sums + v * v
        offset += PANEL * columns
    norms = np.empty((1, WIDTH), np.float32)
    stored(norms, 0, sums)
    return norms


@njit
def means(weights, k, n):
    """W^T k, Eq. 4 over alpha^2: (at least n, WIDTH) for k (N, WIDTH)."""
    N = k.shape[0]
    mean = np.empty((n + PANEL, WIDTH), np.float32)
    for first in range(0, n, PANEL):
        row = first
        for v in product(weights, first * N, N, k):
            stored(mean, row, v)
            row += 1
    return mean


@kernel(correction_signature(GP_DATA))
def correct(x, u, data, correction):
    """exp(-d |sigma|^2) times the mean, from (points, U, W, rows of U, 1 / scale, (alpha^2, prior, d n)).

    With d n = 0 it is the mean alone, and needs no U.
    """
    points, triangle, weights, rows, inverse_scale, constants = data
    alpha_squared, prior, d_n = constants[0], constants[1], constants[2]
    a, n = x.shape
    if points.shape[0] == 0:
        correction[:] = 0.0
        return
    for first in range(0, a, WIDTH):
        last = min(first + WIDTH, a)
        k = correlations(x[first:last], u[first:last], points, inverse_scale)
        mean = means(weights, k, n)
        norms = squared_norms(triangle, k[:rows]) if d_n > 0.0 else np.zeros((1, WIDTH), np.float32)
        for b in range(first, last):
            variance = prior - alpha_squared**2 * norms[0, b - first]  # Eq. 5
            weight = alpha_squared * np.exp(-d_n * variance)
            for i in range(n):
                correction[b, i] = weight * mean[i, b - first]  # Eq. 7
