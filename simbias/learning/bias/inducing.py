"""Inducing points, chosen greedily from the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg import solve_triangular

from simbias.core.ranges import Count
from simbias.core.records import Array
from simbias.learning.covariance import Hyperparameters, stable_cholesky

Tolerance = Annotated[float, Field(gt=0, lt=1)]


@dataclass(frozen=True)
class Inducing:
    """Limits for the choice of inducing points.

    The variance uses only the first of the points: it needs fewer than the mean, whose weights are large, and
    its cost grows with their number squared.
    """

    points: Count = 200  # maximum number
    tolerance: Tolerance = 1e-4  # stop once the variance at all other points is below this share of alpha^2
    variance_tolerance: Tolerance = 1e-3  # the same for the points of the variance; at least `tolerance`

    def __post_init__(self) -> None:
        """Check that the points for the variance are among those for the mean."""
        if self.variance_tolerance < self.tolerance:
            raise ValueError(
                f"variance_tolerance {self.variance_tolerance:g} is below tolerance {self.tolerance:g}"
            )


@dataclass(frozen=True, eq=False)
class View:
    """Factors of the sparse posterior of N points with m inducing points Z."""

    Z: Array  # (m, r)
    K_ZX: Array  # (m, N)
    L_inverse: Array  # (m, m) L^-1 of K_ZZ = L L^T
    R: Array  # (m, m) R^T R = S = (K_ZZ + K_ZX K_XZ / sigma^2)^-1


def choose(hyper: Hyperparameters, points: Array, inducing: Inducing) -> tuple[list[int], int]:
    """Indices of the inducing points among scaled points (N, r), and the number used for the variance.

    They are the first pivots of a pivoted Cholesky factorisation of the covariance: each is the point whose
    latent value is least certain given the earlier ones.
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
    """Factors for scaled points (N, r) with the chosen ones as inducing points."""
    Z = points[chosen]
    K_ZX = hyper.covariance(Z, points)
    identity = np.eye(len(chosen))
    L_inverse = solve_triangular(stable_cholesky(K_ZX[:, chosen]), identity, lower=True)
    A = L_inverse @ K_ZX / np.sqrt(hyper.noise_variance)
    R = solve_triangular(stable_cholesky(identity + A @ A.T), L_inverse, lower=True)
    return View(Z, K_ZX, L_inverse, R)
