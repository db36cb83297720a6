"""How errors of predictions over windows are distributed: their covariance, and how much windows tell anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.records import Array
from simbias.simulation.open_loop import Windows

CLIP = 4.0  # robust standard deviations, beyond which an error is an outlier
TINY = 1e-6  # of what a state varies: no error is known better


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of windows, N(0, covariance) each."""

    factor: Array  # (J n, J n) lower factor L of the covariance
    share: float  # of the windows that tell something new; 1 if their errors are independent

    @staticmethod
    def of(errors: Array, windows: Windows) -> Errors:
        """Estimated from errors (w, J, n), some of which may be outliers or no numbers.

        The covariance is shrunk towards its diagonal, the more the fewer windows there are.
        """
        w, _, n = errors.shape
        e = np.nan_to_num(errors, nan=np.inf).reshape(w, -1)
        least = np.tile(TINY * np.std(windows.states, axis=0) + 1e-12, e.shape[1] // n)
        scale = np.maximum(np.median(np.abs(e), axis=0) / 0.6745, least)
        scale = np.minimum(scale, 1e6)
        clipped = np.clip(e, -CLIP * scale, CLIP * scale)
        covariance = clipped.T @ clipped / w
        variances = np.diag(covariance) + least**2
        shrink = len(variances) / (len(variances) + w)
        factor = np.linalg.cholesky((1.0 - shrink) * covariance + np.diag(shrink * variances))
        made = Errors(factor, 1.0)
        return Errors(
            factor, 1.0 / correlation_time(np.clip(made.whitened(errors), -CLIP, CLIP), windows.experiments)
        )

    def whitened(self, errors: Array) -> Array:
        """Whitened errors (..., J n) of errors (..., J, n)."""
        flat = errors.reshape(*errors.shape[:-2], -1)
        white = flat @ np.linalg.inv(self.factor).T
        return np.clip(np.nan_to_num(white, nan=1e6), -1e6, 1e6)

    def log_likelihoods(self, errors: Array) -> Array:
        """Log-likelihoods (w,) of errors (w, J, n), in nats; outliers count as soft L1 has it."""
        r = self.whitened(errors)
        rho = 2.0 * (np.sqrt(1.0 + r * r) - 1.0)
        constant = np.sum(np.log(np.diag(self.factor))) + 0.5 * r.shape[-1] * np.log(2.0 * np.pi)
        return -0.5 * rho.sum(axis=-1) - constant


def correlation_time(e: Array, experiments: Array) -> float:
    """1 + 2 sum of the autocorrelations of errors e (w, d) of successive windows, pooled; at least 1.

    The sum ends with the last pair of lags that is positive (Geyer, Statistical Science 7, 1992).
    """
    sums = np.zeros(max(np.bincount(experiments)))
    for experiment in np.unique(experiments):
        own = e[experiments == experiment]
        for lag in range(len(own)):
            sums[lag] += np.sum(own[lag:] * own[: len(own) - lag])
    time, lag = 1.0, 1
    while lag + 1 < len(sums) and sums[lag] + sums[lag + 1] > 0 < sums[0]:
        time += 2.0 * (sums[lag] + sums[lag + 1]) / sums[0]
        lag += 2
    return time
