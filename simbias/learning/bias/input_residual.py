"""A residual of the input instead of the state: the additional input that would explain the error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.covariance import output_scale

STEP = 1e-3  # step of inputs, in their units, for derivatives of the model


class InputResidual(GaussianProcess):
    """Gaussian processes of the part of a residual that a change delta u of the input would explain.

    This is a delta action, which ASAP learns with a neural network (He et al., arXiv:2502.01143), to first
    order. From the residual Delta at a sample, B delta u is learned: delta u is the least-squares solution of
    B delta u = Delta, and B is the nominal model's input Jacobian there. It covers effects that act through
    the motors, such as a gain, friction or an offset; everything else is left out.
    """

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data and the (identified) nominal model that the residuals refer to.

        Raises
        ------
        ValueError
            If inputs have no effect in this model, so that none can explain a residual.
        """
        x, u = np.split(transitions.inputs, [transitions.residuals.shape[1]], axis=1)
        lower, upper = np.nan_to_num(self._task.input_bounds, posinf=1.0, neginf=-1.0)
        least, most = (np.full_like(u, upper - share * (upper - lower)) for share in (0.7, 0.0))
        if len(x) and np.array_equal(nominal.step(x, least), nominal.step(x, most)):
            raise ValueError("bias=input_residual: the nominal model does not depend on the inputs")
        return self.fit(Transitions(transitions.inputs, through_inputs(transitions, nominal)))


def through_inputs(transitions: Transitions, nominal: Nominal) -> Array:
    """B delta u (N, n) of residuals (N, n), with all states weighted equally."""
    residuals = transitions.residuals
    scale = np.where(size := output_scale(residuals), size, 1.0)
    x, u = np.split(transitions.inputs, [residuals.shape[1]], axis=1)
    steps = STEP * np.eye(u.shape[1])
    slopes = [(nominal.step(x, u + step) - nominal.step(x, u - step)) / (2 * STEP) for step in steps]
    B = np.stack(slopes, axis=-1) / scale[:, None]  # (N, n, m)
    return scale * (B @ (np.linalg.pinv(B) @ (residuals / scale)[..., None]))[..., 0]
