"""Controls: learners with the same data as the paper's learner, except for the part claimed to help.

If a trial does as well with them, the state dependence of the bias is not what helps.
"""

from __future__ import annotations

import numpy as np

from simbias.core import Bias, FittedBias
from simbias.core.records import Transitions
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.bias.none import ConstantBias, ZeroBias

SEED = 0  # of the permutation, so that the same data give the same bias


class PermutedGaussianProcess(GaussianProcess):
    """Gaussian processes of residuals that are permuted among the samples before each fit.

    Size and number of the residuals and the inputs stay, but residuals no longer belong to their states.
    """

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the inputs and the permuted residuals."""
        order = np.random.default_rng(SEED).permutation(len(transitions))
        return super().fit(Transitions(transitions.inputs, transitions.residuals[order]))


class MeanBias(Bias):
    """The mean residual, constant everywhere."""

    def fit(self, transitions: Transitions) -> FittedBias:
        """Average the residuals; without data, zero."""
        residuals = transitions.residuals
        if not len(residuals):
            return ZeroBias(residuals.shape[1])
        return ConstantBias(residuals.mean(axis=0), residuals.var(axis=0))
