"""A residual on accelerations in place of the whole state."""

from __future__ import annotations

import numpy as np

from simbias.core import FittedBias, rates_and_positions
from simbias.core.records import Transitions
from simbias.learning.bias.gp import GaussianProcess


class AccelerationResidual(GaussianProcess):
    """Gaussian processes of the residuals of velocities alone, as forces that the model lacks act on these.

    A position's residual is a multiple of its velocity's, the same everywhere, which the data tell: a time of
    half a frame where an acceleration is constant in a frame, a frame in semi-implicit Euler's steps. One of
    the representations that Section VII asks for.

    Raises
    ------
    ValueError
        If a task has not a velocity for each other state, in its unit per second.
    """

    version = 2

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the residuals of velocities, and on their multiples in place of those of positions."""
        rates, positions = rates_and_positions(self._task.states)
        residuals = transitions.residuals.copy()
        size = np.sum(np.square(residuals[:, rates]), axis=0)
        along = np.sum(residuals[:, positions] * residuals[:, rates], axis=0)
        times = np.divide(along, size, out=np.zeros_like(size), where=size > 0)  # (n / 2,) s
        residuals[:, positions] = times * residuals[:, rates]
        return super().fit(Transitions(transitions.inputs, residuals))
