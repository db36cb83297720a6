"""The compiled correction of a Gaussian-process bias (Eq. 4, 5 and 7), for rollouts in lockstep.

A policy search spends most of its time here: on N^2 / 2 products for the variance of each step. A single step
would be bound by reading the factor from the cache; rollouts in lockstep, one in each lane, share one read.
Single precision halves the traffic, and the triangle L^-1 halves it again compared with K^-1. The sum of
squares |L^-1 k|^2 has no cancellation, so the error stays near 1e-6 of the signal variance.

Its sums stay in registers thanks to `simbias.simulation.compiler.lanes`. With loops over the lanes of arrays,
it takes 2.8 times as long.
"""

from __future__ import annotations

import numpy as np

from simbias.core.records import Array
from simbias.simulation.compiler import (
    LANES,
    broadcast,
    cosine_of_turns,
    everywhere,
    exp,
    fma,
    load,
    sincos,
    store,
)

PANEL = 6  # rows multiplied together; with 16 lanes they fill the registers of AVX2


def pack_triangle(U: Array) -> np.ndarray:
    """The panels of a lower triangle (N, N), concatenated, each without the zeros on its right."""
    return _pack([U[first : first + PANEL, : first + PANEL] for first in range(0, len(U), PANEL)])


def pack(M: Array) -> np.ndarray:
    """The panels of a matrix (k, N), concatenated."""
    return _pack([M[first : first + PANEL] for first in range(0, len(M), PANEL)])


def _pack(panels: list[Array]) -> np.ndarray:
    """Panels of PANEL rows each, zero-padded, column by column."""
    filled = [np.pad(panel, ((0, PANEL - len(panel)), (0, 0))) for panel in panels]
    return np.concatenate([np.zeros(0), *(panel.T.ravel() for panel in filled)]).astype(np.float32)


def coordinates_of(x, u, inverse_scale, centre, angles):
    """Scaled coordinates (r, LANES) of states x (n, LANES) under u (m, LANES): `Hyperparameters.scale`."""
    n, r = x.shape[0], inverse_scale.shape[0]
    raw = r - angles.shape[0]
    coordinates = np.empty((r, LANES), np.float32)
    for i in range(raw):
        for lane in range(LANES):
            coordinates[i, lane] = inverse_scale[i] * (x[i, lane] if i < n else u[i - n, lane]) - centre[i]
    for j in range(angles.shape[0]):
        i = angles[j]
        for lane in range(LANES):
            sine, cosine = sincos(x[i, lane])
            coordinates[i, lane] = inverse_scale[i] * sine - centre[i]
            coordinates[raw + j, lane] = inverse_scale[raw + j] * cosine - centre[raw + j]
    return coordinates


def correlations(coordinates, points):
    """k (N, LANES) of Eq. 4, divided by alpha^2, at scaled coordinates (r, LANES)."""
    N, r = points.shape
    k = np.empty((N, LANES), np.float32)
    for j in range(N):
        squared_distance = everywhere(np.float32(0.0))
        for i in range(r):
            difference = load(coordinates, i) - everywhere(points[j, i])
            squared_distance = fma(difference, difference, squared_distance)
        store(k, j, exp(everywhere(np.float32(-0.5)) * squared_distance))
    return k


def waves(coordinates, frequencies):
    """Cosines (F, LANES) at coordinates (r, LANES), with frequencies (F, r + 1) in turns, phases last."""
    F, columns = frequencies.shape
    values = np.empty((F, LANES), np.float32)
    for j in range(F):
        turns = everywhere(frequencies[j, columns - 1])
        for i in range(columns - 1):
            turns = fma(everywhere(frequencies[j, i]), load(coordinates, i), turns)
        store(values, j, cosine_of_turns(turns))
    return values


def product(panels, offset, columns, k):
    """The panel at this offset, with PANEL rows, times as many rows of k (N, LANES) as it has columns."""
    v0 = v1 = v2 = v3 = v4 = v5 = everywhere(np.float32(0.0))
    for j in range(columns):
        k_j = load(k, j)
        v0 = fma(broadcast(panels, offset), k_j, v0)
        v1 = fma(broadcast(panels, offset + 1), k_j, v1)
        v2 = fma(broadcast(panels, offset + 2), k_j, v2)
        v3 = fma(broadcast(panels, offset + 3), k_j, v3)
        v4 = fma(broadcast(panels, offset + 4), k_j, v4)
        v5 = fma(broadcast(panels, offset + 5), k_j, v5)
        offset += PANEL
    return v0, v1, v2, v3, v4, v5


def squared_norms(triangle, k, N):
    """|U k|^2 (LANES,) for each column k of k (at least N, LANES)."""
    sums = everywhere(np.float32(0.0))
    offset = 0
    for first in range(0, N, PANEL):
        columns = min(first + PANEL, N)
        for v in product(triangle, offset, columns, k):
            sums = fma(v, v, sums)
        offset += PANEL * columns
    norms = np.empty(LANES, np.float32)
    store(norms, 0, sums)
    return norms


def means(weights, k, n):
    """W^T k, Eq. 4 divided by alpha^2: (at least n, LANES) for k (N, LANES)."""
    N = k.shape[0]
    mean = np.empty((n + PANEL, LANES), np.float32)
    for first in range(0, n, PANEL):
        row = first
        for v in product(weights, first * N, N, k):
            store(mean, row, v)
            row += 1
    return mean


def add_linear(coefficients, coordinates, values):
    """Add linear functions (n, r + 1) of coordinates (r, LANES) to values (n, LANES), constants last."""
    n, columns = coefficients.shape
    for i in range(n):
        value = load(values, i) + everywhere(coefficients[i, columns - 1])
        for j in range(columns - 1):
            value = fma(everywhere(coefficients[i, j]), load(coordinates, j), value)
        store(values, i, value)


def factor(norm, constants):
    """Factor of W^T k in Eq. 7, from |U k|^2."""
    alpha_squared, prior, d_n = constants[0], constants[1], constants[2]
    variance = prior - alpha_squared**2 * norm  # Eq. 5
    return alpha_squared * np.exp(-d_n * variance)


def correct(x, u, data, correction):
    """exp(-d |sigma|^2) times the mean, for states x (n, LANES) under u (m, LANES).

    The data are: points (N, r), U, W, the number of rows of U, 1 / scale, the centre, (alpha^2, prior, d n),
    the columns of angles; and, for the added terms, frequencies and amplitudes of waves, and coefficients of
    linear functions. With d n = 0 the result is the unweighted mean, and U is not needed.
    """
    (
        points,
        triangle,
        weights,
        rows,
        inverse_scale,
        centre,
        constants,
        angles,
        frequencies,
        amplitudes,
        linear,
    ) = data
    n = x.shape[0]
    coordinates = coordinates_of(x, u, inverse_scale, centre, angles)
    added = means(amplitudes, waves(coordinates, frequencies), n)
    add_linear(linear, coordinates, added)
    k = correlations(coordinates, points)
    mean, norms = means(weights, k, n), squared_norms(triangle, k, rows)
    for lane in range(LANES):
        weight = factor(norms[lane], constants)
        for i in range(n):
            correction[i, lane] = weight * mean[i, lane] + added[i, lane]
