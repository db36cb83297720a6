"""A residual of accelerations instead of the whole state."""

from __future__ import annotations

import numpy as np

from simbias.core import FittedBias, rates_and_positions
from simbias.core.records import Transitions
from simbias.learning.bias.gp import GaussianProcess


class AccelerationResidual(GaussianProcess):
    """Gaussian processes of velocity residuals alone, since unmodelled forces act on velocities.

    A position's residual is a constant multiple of its velocity's residual, estimated from the data: half a
    frame if the acceleration is constant in a frame, one frame for semi-implicit Euler steps. In draws of the
    posterior, both are drawn independently. This is one of the representations that Section VII suggests.

    Raises
    ------
    ValueError
        If a task lacks a velocity, in its unit per second, for one of the other states.
    """

    version = 2

    def fit(self, transitions: Transitions) -> FittedBias:
        """Condition on the residuals of velocities, and on multiples of them as residuals of positions."""
        rates, positions = rates_and_positions(self._task.states)
        residuals = transitions.residuals.copy()
        size = np.sum(np.square(residuals[:, rates]), axis=0)
        along = np.sum(residuals[:, positions] * residuals[:, rates], axis=0)
        times = np.divide(along, size, out=np.zeros_like(size), where=size > 0)  # (n / 2,) s
        residuals[:, positions] = times * residuals[:, rates]
        return super().fit(Transitions(transitions.inputs, residuals))
