"""No bias learning: g = 0."""

from __future__ import annotations

import numpy as np

from simbias.core import Bias, FittedBias
from simbias.core.records import Array, Transitions
from simbias.simulation.compiler import zero


class ZeroBias(FittedBias):
    """g = 0 without uncertainty."""

    def __init__(self, n: int) -> None:
        self._n = n
        self.kernel = zero(n)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n): zeros."""
        return np.zeros((len(inputs), self._n)), np.zeros((len(inputs), self._n))

    def correction(self, x: Array, u: Array) -> Array:
        """Zeros (..., n)."""
        return np.zeros_like(x)


class NoBias(Bias):
    """Trusts the nominal model: the baseline that learns nothing."""

    def fit(self, transitions: Transitions) -> FittedBias:
        """g = 0, for any data."""
        return ZeroBias(transitions.residuals.shape[1])
