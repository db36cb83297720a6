"""Constant biases, and no bias learning: g = 0."""

from __future__ import annotations

import numpy as np

from simbias.core import Bias, FittedBias
from simbias.core.records import Array, Transitions
from simbias.simulation.compiler import constant


class ConstantBias(FittedBias):
    """A bias with constant mean (n,) and variance (n,)."""

    def __init__(self, mean: Array, variance: Array) -> None:
        self._mean, self._variance = mean, variance
        self.kernel = constant(mean)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n)."""
        return np.tile(self._mean, (len(inputs), 1)), np.tile(self._variance, (len(inputs), 1))

    def correction(self, x: Array, u: Array) -> Array:
        """The mean (..., n)."""
        return np.zeros_like(x) + self._mean


class ZeroBias(ConstantBias):
    """g = 0 without uncertainty, for n states."""

    def __init__(self, n: int) -> None:
        super().__init__(np.zeros(n), np.zeros(n))


class NoBias(Bias):
    """Trusts the nominal model: the baseline that learns nothing."""

    def fit(self, transitions: Transitions) -> FittedBias:
        """g = 0, for any data."""
        return ZeroBias(transitions.residuals.shape[1])
