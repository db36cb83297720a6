"""Controls: learners that are given what the paper's learner is given, but for what is said to help.

If a trial does as well with them, a bias that depends on the state is not what helps.
"""

from __future__ import annotations

import numpy as np

from simbias.core import Bias, FittedBias
from simbias.core.records import Transitions
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.bias.none import ConstantBias, ZeroBias

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
        if not len(residuals):
            return ZeroBias(residuals.shape[1])
        return ConstantBias(residuals.mean(axis=0), residuals.var(axis=0))
