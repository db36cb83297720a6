"""A residual on the input in place of the state: what the inputs would have had to add."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.covariance import output_scale

STEP = 1e-3  # of states' unit inputs, for derivatives of the model


class InputResidual(GaussianProcess):
    """Gaussian processes of the part of a residual that a delta u could have caused.

    A delta action, as ASAP learns by a neural network (He et al., arXiv:2502.01143), to first order: of the
    residual Delta at a sample, B delta u is learned, where delta u is the least-squares solution of
    B delta u = Delta, and B the slope of the nominal model there. What acts through the motors, as a gain,
    friction or an offset, is of this kind; all else is left out.
    """

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the data and the (identified) nominal model that it comes from.

        Raises
        ------
        ValueError
            If inputs do not act in this model, so that none could have caused a residual.
        """
        x, u = np.split(transitions.inputs, [transitions.residuals.shape[1]], axis=1)
        lower, upper = np.nan_to_num(self._task.input_bounds, posinf=1.0, neginf=-1.0)
        least, most = (np.full_like(u, upper - share * (upper - lower)) for share in (0.7, 0.0))
        if len(x) and np.array_equal(nominal.step(x, least), nominal.step(x, most)):
            raise ValueError("bias=input_residual: the nominal model does not depend on the inputs")
        return self.fit(Transitions(transitions.inputs, through_inputs(transitions, nominal)))


def through_inputs(transitions: Transitions, nominal: Nominal) -> Array:
    """B delta u (N, n) of residuals (N, n), in which all states weigh alike."""
    residuals = transitions.residuals
    scale = np.where(size := output_scale(residuals), size, 1.0)
    x, u = np.split(transitions.inputs, [residuals.shape[1]], axis=1)
    steps = STEP * np.eye(u.shape[1])
    slopes = [(nominal.step(x, u + step) - nominal.step(x, u - step)) / (2 * STEP) for step in steps]
    B = np.stack(slopes, axis=-1) / scale[:, None]  # (N, n, m)
    return scale * (B @ (np.linalg.pinv(B) @ (residuals / scale)[..., None]))[..., 0]
