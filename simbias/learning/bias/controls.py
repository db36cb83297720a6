"""Controls: learners that are given what the paper's learner is given, but for what is said to help.

If a trial does as well with them, a bias that depends on the state is not what helps.
"""

from __future__ import annotations

import numpy as np

from simbias.core import Bias, FittedBias
from simbias.core.records import Array, Transitions
from simbias.learning.bias.gp import GaussianProcess

SEED = 0  # of the permutation: the same data give the same bias


class PermutedGaussianProcess(GaussianProcess):
    """Gaussian processes of residuals that are permuted over the samples before each fit.

    Size and number of the residuals stay, and where the data lie; that a residual belongs to its state goes.
    """

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the inputs and on the residuals of others."""
        order = np.random.default_rng(SEED).permutation(len(transitions))
        return super().fit(Transitions(transitions.inputs, transitions.residuals[order]))


class MeanBias(Bias):
    """The mean residual, the same everywhere: as much as a constant offset."""

    def fit(self, transitions: Transitions) -> FittedBias:
        """Average the residuals; without data, zero."""
        residuals = transitions.residuals
        mean = residuals.mean(axis=0) if len(residuals) else np.zeros(residuals.shape[1])
        variance = residuals.var(axis=0) if len(residuals) else np.zeros(residuals.shape[1])
        return ConstantBias(mean, variance)


class ConstantBias(FittedBias):
    """A bias with constant mean (n,) and variance (n,)."""

    def __init__(self, mean: Array, variance: Array) -> None:
        self._mean, self._variance = mean, variance

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n)."""
        return np.tile(self._mean, (len(inputs), 1)), np.tile(self._variance, (len(inputs), 1))

    def correction(self, x: Array, u: Array) -> Array:
        """The mean (..., n)."""
        return np.zeros_like(x) + self._mean
