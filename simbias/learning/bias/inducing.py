"""Inducing points: all data, seen through few of its points, chosen greedily."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg import solve_triangular

from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.learning.bias.covariance import Hyperparameters, stable_cholesky

Tolerance = Annotated[float, Field(gt=0, lt=1)]


@dataclass(frozen=True)
class Inducing:
    """How inducing points are chosen.

    The variance needs fewer than the mean, whose weights are large, and takes their number squared: it is
    seen through the first of them.
    """

    points: Count = 200  # at most
    tolerance: Tolerance = 1e-4  # no more, once all other points are known to this part of alpha^2
    variance_tolerance: Tolerance = 1e-3  # likewise, of those for the variance; at least `tolerance`

    def __post_init__(self) -> None:
        """Check that the points for the variance are among those for the mean."""
        if self.variance_tolerance < self.tolerance:
            raise ValueError(
                f"variance_tolerance {self.variance_tolerance:g} is below tolerance {self.tolerance:g}"
            )


@dataclass(frozen=True, eq=False)
class View:
    """N points seen through m inducing ones Z."""

    Z: Array  # (m, r)
    K_ZX: Array  # (m, N)
    L_inverse: Array  # (m, m) L^-1 of K_ZZ = L L^T
    R: Array  # (m, m) R^T R = S = (K_ZZ + K_ZX K_XZ / sigma^2)^-1


def choose(hyper: Hyperparameters, points: Array, inducing: Inducing) -> tuple[list[int], int]:
    """Indices of the inducing points among points (N, r), scaled; how many, the first, the variance needs.

    They are those that a pivoted Cholesky factorisation of the covariance takes first: each is the point
    whose latent value is the least certain given those before it.
    """
    variance = np.full(len(points), hyper.signal_variance)
    factor = np.zeros((min(inducing.points, len(points)), len(points)))
    chosen: list[int] = []
    for_variance = 0
    for i in range(len(factor)):
        pivot = int(np.argmax(variance))
        if variance[pivot] < inducing.tolerance * hyper.signal_variance:
            break
        for_variance += bool(variance[pivot] >= inducing.variance_tolerance * hyper.signal_variance)
        row = hyper.covariance(points[[pivot]], points)[0] - factor[:i, pivot] @ factor[:i]
        factor[i] = row / np.sqrt(variance[pivot])
        variance = np.maximum(variance - factor[i] ** 2, 0.0)
        variance[pivot] = 0.0
        chosen.append(pivot)
    return chosen, for_variance


def view(hyper: Hyperparameters, points: Array, chosen: Sequence[int]) -> View:
    """See points (N, r), scaled, through the chosen of them."""
    Z = points[chosen]
    K_ZX = hyper.covariance(Z, points)
    identity = np.eye(len(chosen))
    L_inverse = solve_triangular(stable_cholesky(K_ZX[:, chosen]), identity, lower=True)
    A = L_inverse @ K_ZX / np.sqrt(hyper.noise_variance)
    R = solve_triangular(stable_cholesky(identity + A @ A.T), L_inverse, lower=True)
    return View(Z, K_ZX, L_inverse, R)
