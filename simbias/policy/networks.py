"""Functions of a vector with weights that are searched."""

from __future__ import annotations

from typing import Literal

import numpy as np

from simbias.core.records import Array

Kind = Literal["mlp", "rbf"]


class Perceptron:
    """tanh(W_2 tanh(W_1 z + b_1) + b_2): one hidden layer."""

    def __init__(self, q: int, m: int, units: int, bound: float) -> None:
        self._shapes = (units, q), (units, 1), (m, units), (m, 1)
        p = sum(rows * columns for rows, columns in self._shapes)
        self.bounds = np.full(p, -bound), np.full(p, bound)

    def __call__(self, weights: Array, z: Array) -> Array:
        """Values (..., m) at z (..., q)."""
        W_1, b_1, W_2, b_2 = _matrices(weights, self._shapes)
        return np.tanh(W_2 @ np.tanh(W_1 @ z[..., None] + b_1) + b_2)[..., 0]


class RadialBasis:
    """Radial basis functions of centres and common widths, squashed by (9 sin v + sin 3v) / 8.

    As in M. P. Deisenroth, C. E. Rasmussen, PILCO: A Model-Based and Data-Efficient Approach, 2011.
    """

    def __init__(self, q: int, m: int, units: int, bound: float) -> None:
        self._shapes = (units, q), (1, q), (m, units)
        sizes = [rows * columns for rows, columns in self._shapes]
        upper = np.repeat([bound, np.log(1 + bound), bound], sizes)
        self.bounds = -upper, upper

    def __call__(self, weights: Array, z: Array) -> Array:
        """Values (..., m) at z (..., q)."""
        centres, log_widths, W = _matrices(weights, self._shapes)
        squares = np.square((z[..., None, :] - centres) * np.exp(-log_widths)).sum(axis=-1)
        v = (W @ np.exp(-0.5 * squares)[..., None])[..., 0]
        return (9.0 * np.sin(v) + np.sin(3.0 * v)) / 8.0


def _matrices(weights: Array, shapes: tuple[tuple[int, int], ...]) -> list[Array]:
    """Weights (..., p) as matrices (..., rows, columns)."""
    matrices, begin = [], 0
    for rows, columns in shapes:
        end = begin + rows * columns
        matrices.append(weights[..., begin:end].reshape(*weights.shape[:-1], rows, columns))
        begin = end
    return matrices


NETWORKS: dict[Kind, type[Perceptron | RadialBasis]] = {"mlp": Perceptron, "rbf": RadialBasis}
