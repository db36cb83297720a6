"""A residual on accelerations in place of the whole state."""

from __future__ import annotations

import numpy as np

from simbias.core import FittedBias
from simbias.core.records import Transitions
from simbias.learning.bias.gp import GaussianProcess


class AccelerationResidual(GaussianProcess):
    """Gaussian processes of the residuals of velocities alone, as forces that the model lacks act on these.

    Positions follow in the next frame, by the model: of their residual in a frame, dt / 2 times that of the
    velocity is left out. One of the representations that Section VII asks for.
    """

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the residuals of velocities; those of positions count as zero."""
        rates = np.array([state.is_rate for state in self._task.states])
        return super().fit(Transitions(transitions.inputs, transitions.residuals * rates))
