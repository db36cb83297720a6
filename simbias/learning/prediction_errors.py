"""How errors of predictions over windows are distributed, and how much each window tells anew."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from simbias.core.records import Array, Indices
from simbias.learning.measurement import Linearised, covariance_of_noise
from simbias.simulation.open_loop import Windows

FREEDOM = 1.0  # nu / d: a window whose errors are ten times as large as usual counts a fiftieth
ROUNDS = 5  # of expectation maximisation; the weights have settled then
TINY = 1e-6  # of what a state varies: no error is known better
HUGE = 1e6  # standard deviations, in place of what is no number


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of windows: each has Student's t distribution in all d = J n numbers together.

    So a window in which something happens that the model does not know counts little as a whole (K. L. Lange,
    R. J. A. Little and J. M. G. Taylor, Journal of the American Statistical Association 84, 1989).
    """

    factor: Array  # (d, d) lower factor L of the scale matrix
    freedom: float = FREEDOM
    share: float = 1.0  # of the windows that tells something new; 1 if their errors are independent

    @staticmethod
    def of(
        errors: Array, windows: Windows, freedom: float = FREEDOM, linearised: Linearised | None = None
    ) -> Errors:
        """Estimated from errors (w, J, n), some of which may be outliers or no numbers.

        The scale matrix is shrunk, the more the fewer windows there are: towards that of noise in the
        measured states where the predictions are linearised, else towards its diagonal.
        """
        w, J = errors.shape[:2]
        least = np.tile(TINY * np.std(windows.states, axis=0) + 1e-12, J)
        e = np.nan_to_num(errors.reshape(w, -1), nan=np.inf)
        scale = np.clip(np.median(np.abs(e), axis=0) / 0.6745, least, HUGE)
        e = np.clip(e, -HUGE * scale, HUGE * scale)
        made = Errors(np.diag(scale), freedom)
        shrink = len(least) / (len(least) + w)
        for _ in range(ROUNDS):
            weights = made.weights(made.whiten(errors))
            covariance = e.T @ (weights[:, None] * e) / w + np.diag(least**2)
            target = np.diag(np.diag(covariance))
            if linearised is not None:
                covariance += linearised.doubt(weights)
                target = covariance_of_noise(e, weights, linearised, least)
            made = Errors(np.linalg.cholesky((1.0 - shrink) * covariance + shrink * target), freedom)
        white = made.whiten(errors)
        weighted = np.sqrt(made.weights(white))[:, None] * white
        return replace(made, share=1.0 / correlation_time(weighted, windows.experiments))

    @cached_property
    def inverse(self) -> Array:
        """L^-1 (d, d), which a fit asks for a hundred times."""
        inverse: Any = np.linalg.inv(self.factor)
        return inverse

    def whiten(self, errors: Array) -> Array:
        """Whitened errors (..., d) of errors (..., J, n)."""
        white = errors.reshape(*errors.shape[:-2], -1) @ self.inverse.T
        return np.clip(np.nan_to_num(white, nan=HUGE), -HUGE, HUGE)

    def weights(self, white: Array) -> Array:
        """How much windows (w, d) of whitened errors count: less than 1 if they are large."""
        return (self.freedom + 1.0) / (self.freedom + np.mean(white**2, axis=-1))

    def losses(self, white: Array) -> Array:
        """Twice the negative logarithms (w,) of the density of whitened errors (w, d), but for a constant."""
        return (self.freedom + 1.0) * white.shape[-1] * np.log1p(np.mean(white**2, axis=-1) / self.freedom)

    def log_likelihoods(self, errors: Array) -> Array:
        """Log-likelihoods (w,) of errors (w, J, n), in nats."""
        from scipy.special import gammaln  # lazily: few trials need it

        d, nu = len(self.factor), self.freedom * len(self.factor)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - 0.5 * d * np.log(nu * np.pi)
        return constant - np.sum(np.log(np.diag(self.factor))) - 0.5 * self.losses(self.whiten(errors))


def correlation_time(e: Array, experiments: Indices) -> float:
    """1 + 2 sum of the autocorrelations of errors e (w, d) of successive windows, pooled; at least 1.

    The sum ends with the last pair of lags that is positive (C. J. Geyer, Statistical Science 7, 1992).
    """
    sums = np.zeros(max(np.bincount(experiments)))
    for experiment in np.unique(experiments):
        own = e[experiments == experiment]
        for lag in range(len(own)):
            sums[lag] += np.sum(own[lag:] * own[: len(own) - lag])
    time, lag = 1.0, 1
    while lag + 1 < len(sums) and sums[lag] + sums[lag + 1] > 0 < sums[0]:
        time += 2.0 * float(sums[lag] + sums[lag + 1]) / float(sums[0])
        lag += 2
    return time
