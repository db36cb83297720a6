"""The compiled correction of a Gaussian-process bias (Eq. 4, 5 and 7), for several steps at once.

Most of a policy search is spent here: on N^2 / 2 products for the variance of each step. One step alone is
bound by reading the factor from the cache; single precision halves that, the triangle L^-1 halves it again
against K^-1, and the rollouts that run in step, one in each lane, share one reading. Few rollouts would leave
most lanes idle; each of them then has lanes for points, and for rows of the factor. The sum of squares
|L^-1 k|^2 has no cancellation, so the error stays near 1e-6 of the signal variance.

Both ways make the same operations in the same order: what a rollout gives does not depend on those beside it.
"""

from __future__ import annotations

import numpy as np
from numba import float32, int64, njit, types

from simbias.records import Array
from simbias.simulation.kernels import VECTOR, correction_signature, kernel
from simbias.simulation.lanes import WIDTH, everywhere, exp, loaded, stored

PANEL = 6  # rows that are multiplied together; with 16 lanes they fill the registers of AVX2
GROUP = 4  # panels of the triangle that have as many columns
FEW = 3  # rollouts that are corrected one by one

SINGLE = float32[:, ::1]
GP_DATA = types.Tuple((int64, SINGLE, float32[::1], float32[::1], int64, VECTOR, VECTOR))


def packed_points(points: Array) -> np.ndarray:
    """Points (N, r) in blocks of WIDTH, in each a row for each coordinate; what is missing is zero."""
    N, r = points.shape
    filled = np.pad(points, ((0, -N % WIDTH), (0, 0)))
    blocks = filled.reshape(len(filled) // WIDTH, WIDTH, r).swapaxes(1, 2)
    return np.ascontiguousarray(blocks, np.float32).reshape(r * len(blocks), WIDTH)


def packed_triangle(U: Array) -> np.ndarray:
    """The panels of a lower triangle (N, N), one after the other, each as wide as its group has to be."""
    rows = PANEL * GROUP
    groups = [U[first : first + rows, : first + rows] for first in range(0, len(U), rows)]
    return _packed([np.pad(group, ((0, -len(group) % rows), (0, 0))) for group in groups])


def packed(M: Array) -> np.ndarray:
    """The panels of a matrix (k, N), one after the other."""
    return _packed([np.pad(M, ((0, -len(M) % PANEL), (0, 0)))])


def _packed(matrices: list[Array]) -> np.ndarray:
    """Panels of PANEL rows each, column by column, with room at the end for reading some more."""
    panels = [M.reshape(len(M) // PANEL, PANEL, M.shape[1]).swapaxes(1, 2).ravel() for M in matrices]
    return np.concatenate([*panels, np.zeros(WIDTH)]).astype(np.float32)


@njit
def correlations(x, u, points, inverse_scale, N):
    """k (N, WIDTH) of Eq. 4, over alpha^2: columns for the states x (a, n) under u (a, m), a <= WIDTH."""
    (a, n), r = x.shape, inverse_scale.size
    coordinates = np.zeros((r, WIDTH), np.float32)
    for b in range(a):
        for i in range(r):
            coordinates[i, b] = inverse_scale[i] * (x[b, i] if i < n else u[b, i - n])
    k = np.empty((N, WIDTH), np.float32)
    for first in range(0, N, WIDTH):
        block = points[first // WIDTH * r : (first // WIDTH + 1) * r]
        for j in range(min(WIDTH, N - first)):
            squared_distance = everywhere(np.float32(0.0))
            for i in range(r):
                difference = loaded(coordinates, i) - everywhere(block[i, j])
                squared_distance = squared_distance + difference * difference
            stored(k, first + j, exp(everywhere(np.float32(-0.5)) * squared_distance))
    return k


@njit
def correlations_of_one(x, u, points, inverse_scale):
    """The same for one state x (n,) under u (m,), WIDTH points at a time: k (at least N,)."""
    n, r = x.size, inverse_scale.size
    blocks = points.shape[0] // r
    coordinates = np.empty(r, np.float32)
    for i in range(r):
        coordinates[i] = inverse_scale[i] * (x[i] if i < n else u[i - n])
    k = np.empty(blocks * WIDTH, np.float32)
    for block in range(blocks):
        squared_distance = everywhere(np.float32(0.0))
        for i in range(r):
            difference = everywhere(coordinates[i]) - loaded(points, block * r + i)
            squared_distance = squared_distance + difference * difference
        stored(k, block * WIDTH, exp(everywhere(np.float32(-0.5)) * squared_distance))
    return k


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
def squared_norms(triangle, k, N):
    """|U k|^2 (WIDTH,) for each column k of k (at least N, WIDTH)."""
    sums = everywhere(np.float32(0.0))
    offset = 0
    for first in range(0, N, PANEL):
        for v in product(triangle, offset, min(first + PANEL, N), k):
            sums = sums + v * v
        offset += PANEL * columns_of_group(first, N)
    norms = np.empty(WIDTH, np.float32)
    stored(norms, 0, sums)
    return norms


@njit
def columns_of_group(row, N):
    """How wide the panels of the group are in which a row lies."""
    return min((row // (PANEL * GROUP) + 1) * PANEL * GROUP, N)


@njit
def squared_norm_of_one(triangle, k, N):
    """|U k|^2 for k (at least N,), the GROUP panels of a group at a time."""
    products = np.zeros((GROUP + 1) * WIDTH, np.float32)
    sums = everywhere(np.float32(0.0))
    offset = 0
    for first in range(0, N, PANEL * GROUP):
        columns = columns_of_group(first, N)
        size = PANEL * columns
        v0 = v1 = v2 = v3 = everywhere(np.float32(0.0))  # of which the first PANEL lanes count
        for j in range(columns):
            k_j = everywhere(k[j])
            v0 = v0 + loaded(triangle, offset) * k_j
            v1 = v1 + loaded(triangle, offset + size) * k_j
            v2 = v2 + loaded(triangle, offset + 2 * size) * k_j
            v3 = v3 + loaded(triangle, offset + 3 * size) * k_j
            offset += PANEL
        offset += (GROUP - 1) * size
        stored(products, 0, v0)
        stored(products, WIDTH, v1)
        stored(products, 2 * WIDTH, v2)
        stored(products, 3 * WIDTH, v3)
        for panel in range(GROUP):
            for row in range(PANEL):
                v = loaded(products, panel * WIDTH + row)  # the first lane counts
                sums = sums + v * v
    norm = np.empty(WIDTH, np.float32)
    stored(norm, 0, sums)
    return norm[0]


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


@njit
def mean_of_one(weights, k, n, N):
    """W^T k, (at least n,) for k (at least N,)."""
    mean = np.empty(n + WIDTH, np.float32)
    for first in range(0, n, PANEL):
        v = everywhere(np.float32(0.0))
        for j in range(N):
            v = v + loaded(weights, first * N + j * PANEL) * everywhere(k[j])
        stored(mean, first, v)
    return mean


@njit
def factor(norm, constants):
    """What W^T k has to be multiplied by (Eq. 7), from |U k|^2."""
    alpha_squared, prior, d_n = constants[0], constants[1], constants[2]
    variance = prior - alpha_squared**2 * norm  # Eq. 5
    return alpha_squared * np.exp(-d_n * variance)


@kernel(correction_signature(GP_DATA))
def correct(x, u, data, correction):
    """exp(-d |sigma|^2) times the mean, for states x (a, n) under u (a, m).

    The data are N, the points, U, W, the rows of U, 1 / scale, and (alpha^2, prior, d n). With d n = 0 it is
    the mean alone, and needs no U.
    """
    N, points, triangle, weights, rows, inverse_scale, constants = data
    a, n = x.shape
    if N == 0:
        correction[:] = 0.0
        return
    for first in range(0, a, WIDTH):
        last = min(first + WIDTH, a)
        if last - first > FEW:
            k = correlations(x[first:last], u[first:last], points, inverse_scale, N)
            mean, norms = means(weights, k, n), squared_norms(triangle, k, rows)
            for b in range(first, last):
                weight = factor(norms[b - first], constants)
                for i in range(n):
                    correction[b, i] = weight * mean[i, b - first]
            continue
        for b in range(first, last):
            k_b = correlations_of_one(x[b], u[b], points, inverse_scale)
            mean_b = mean_of_one(weights, k_b, n, N)
            weight = factor(squared_norm_of_one(triangle, k_b, rows), constants)
            for i in range(n):
                correction[b, i] = weight * mean_b[i]
