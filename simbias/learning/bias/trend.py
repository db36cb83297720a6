"""A linear function that is added to a Gaussian process and learned jointly with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from simbias.core.records import Array
from simbias.learning.covariance import Hyperparameters, stable_cholesky


@dataclass(frozen=True, eq=False)
class Trend:
    """The posterior of b in y = b^T h(x) + g(x), with g a Gaussian process and h (p,) a linear basis.

    The prior of b is normal; its standard deviation is `Hyperparameters.linear` times the root mean square of
    the output. Given b, g is the process of y - b^T h, with weights W - G b (C. E. Rasmussen, C. K. I.
    Williams, Gaussian Processes for Machine Learning, Section 2.7). Without data b is zero.
    """

    mean: Array  # (p, n) of b
    root: Array  # (p, p) R, where R^T R is the covariance of b relative to each output's mean square
    G: Array  # (N, p) the process's weights if each basis function were an output

    @staticmethod
    def learned(
        hyper: Hyperparameters, inputs: Array, y: Array, solve: Callable[[Array], tuple[Array, Array]]
    ) -> Trend:
        """From outputs y (k, n) at scaled inputs (k, r); `solve` gives weights (N, n) and K^-1 y (k, n)."""
        H = hyper.basis(inputs)
        G, of_basis = solve(H)
        if not H.size:
            return Trend(np.zeros((H.shape[1], y.shape[1])), np.zeros((H.shape[1],) * 2), G)
        precision = H.T @ of_basis + np.eye(H.shape[1]) / hyper.linear**2
        root = solve_triangular(stable_cholesky(precision), np.eye(len(precision)), lower=True)
        return Trend(root.T @ (root @ (of_basis.T @ y)), root, G)

    @staticmethod
    def none(points: int, outputs: int) -> Trend:
        """No linear function, for a process of this many points."""
        return Trend(np.empty((0, outputs)), np.empty((0, 0)), np.empty((points, 0)))
