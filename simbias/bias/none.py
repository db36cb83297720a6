"""No bias learning: g = 0."""

from __future__ import annotations

import numpy as np

from simbias.interfaces import Bias, FittedBias, Kernel
from simbias.records import Array, Transitions
from simbias.simulation.kernels import VECTOR, correction_signature, kernel


@kernel(correction_signature(VECTOR))
def _zero(x, u, data, correction):
    """Correct nothing."""
    correction[:, :] = 0.0


class ZeroBias(FittedBias):
    """g = 0, known for sure."""

    def __init__(self, n: int) -> None:
        self._n = n
        self.kernel = Kernel(_zero, np.empty(0))

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n): zeros."""
        return np.zeros((len(inputs), self._n)), np.zeros((len(inputs), self._n))

    def correction(self, x: Array, u: Array) -> Array:
        """Zeros (n,)."""
        return np.zeros(self._n)


class NoBias(Bias):
    """Trusts the nominal model: the baseline that learns nothing."""

    def fit(self, transitions: Transitions) -> FittedBias:
        """g = 0, whatever the data."""
        return ZeroBias(transitions.residuals.shape[1])
