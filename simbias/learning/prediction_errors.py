"""The distribution of window prediction errors, robust to outliers and correlated windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simbias.core.records import Array, Indices
from simbias.learning.measurement_noise import Linearisation, MeasurementNoise
from simbias.learning.noise import robust_deviation
from simbias.simulation.open_loop import Windows

FREEDOM = 1.0  # nu / d: a window with ten times the usual errors has a fiftieth of the usual weight
ROUNDS = 5  # of expectation maximisation, until the weights have converged
RELATIVE_FLOOR = 1e-6  # least error, relative to the standard deviation of a state
CEILING = 1e6  # standard deviations; it replaces non-finite errors


@dataclass(frozen=True, eq=False)
class ErrorDistribution:
    """Multivariate Student's t distribution of the d = J n errors of a window, with nu = freedom * d.

    A window with an unmodelled event has little weight as a whole (K. L. Lange, R. J. A. Little and J. M. G.
    Taylor, Journal of the American Statistical Association 84, 1989).
    """

    factor: Array  # (d, d) lower factor L of the scale matrix
    freedom: float = FREEDOM
    independent_share: float = 1.0  # effective number of windows over the actual one; 1 if independent
    noise: MeasurementNoise | None = None  # None without linearised predictions

    @staticmethod
    def of(
        errors: Array, windows: Windows, freedom: float = FREEDOM, linearisation: Linearisation | None = None
    ) -> ErrorDistribution:
        """Estimate the distribution from errors (w, J, n), some of which may be outliers or not finite.

        The variance of the windows' noise is added to that of the errors, which is therefore never smaller.
        Windows at rest are left out, since their errors are not representative of motion. The fewer the
        windows, the more the scale matrix is shrunk: towards that of measurement noise if linearised
        predictions are given, else towards its diagonal.
        """
        errors = errors[windows.moving]
        if linearisation is not None:
            linearisation = linearisation.of_windows(windows.moving)
        w, J = errors.shape[:2]
        least = np.maximum(RELATIVE_FLOOR * np.std(windows.states, axis=0) + 1e-12, windows.noise)
        floor = np.tile(least, J)
        e = np.nan_to_num(errors.reshape(w, -1), nan=np.inf)
        scale = np.clip(robust_deviation(np.abs(e)), floor, CEILING)
        e = np.clip(e, -CEILING * scale, CEILING * scale)
        estimate = ErrorDistribution(np.diag(scale), freedom)
        shrink, noise = len(floor) / (len(floor) + w), None
        for _ in range(ROUNDS):
            weights = estimate.weights(estimate.whiten(errors))
            covariance = e.T @ (weights[:, None] * e) / w + np.diag(floor**2)
            target = np.diag(np.diag(covariance))
            if linearisation is not None:
                covariance += linearisation.parameter_covariance(weights)
                noise = MeasurementNoise.of(e, weights, linearisation, floor)
                target = noise.covariance(linearisation)
            factor = np.linalg.cholesky((1.0 - shrink) * covariance + shrink * target)
            estimate = ErrorDistribution(factor, freedom, noise=noise)
        white = estimate.whiten(errors)
        weighted = np.sqrt(estimate.weights(white))[:, None] * white
        return replace(
            estimate, independent_share=1.0 / correlation_time(weighted, windows.experiments[windows.moving])
        )

    @cached_property
    def inverse(self) -> Array:
        """L^-1 (d, d), cached: a fit whitens a hundred times."""
        return np.asarray(np.linalg.inv(self.factor))

    def whiten(self, errors: Array) -> Array:
        """Whitened errors (..., d) of errors (..., J, n)."""
        with np.errstate(invalid="ignore"):  # if a model has diverged
            white = errors.reshape(*errors.shape[:-2], -1) @ self.inverse.T
        return np.clip(np.nan_to_num(white, nan=CEILING), -CEILING, CEILING)

    def weights(self, white: Array) -> Array:
        """Weights (w,) of windows with whitened errors (w, d): below 1 where they are larger than usual."""
        return (self.freedom + 1.0) / (self.freedom + np.mean(white**2, axis=-1))

    def losses(self, white: Array) -> Array:
        """Twice the negative log-density (w,) of whitened errors (w, d), up to a constant."""
        return (self.freedom + 1.0) * white.shape[-1] * np.log1p(np.mean(white**2, axis=-1) / self.freedom)

    def log_likelihoods(self, errors: Array) -> Array:
        """Log-likelihoods (w,) in nats of errors (w, J, n)."""
        from scipy.special import gammaln  # lazily: few trials need it

        d, nu = len(self.factor), self.freedom * len(self.factor)
        constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - 0.5 * d * np.log(nu * np.pi)
        return constant - np.sum(np.log(np.diag(self.factor))) - 0.5 * self.losses(self.whiten(errors))


def correlation_time(e: Array, experiments: Indices) -> float:
    """Integrated autocorrelation time of errors e (w, d) of successive windows, pooled over d; at least 1.

    The sum over lags ends with the last positive pair (C. J. Geyer, Statistical Science 7, 1992).
    """
    own = [e[experiments == each] for each in np.unique(experiments)]
    time, lag, square = 1.0, 1, _lagged(own, 0)
    while lag + 1 < max(map(len, own)) and square > 0:
        pair = _lagged(own, lag) + _lagged(own, lag + 1)
        if pair <= 0:
            break
        time += 2.0 * pair / square
        lag += 2
    return time


def _lagged(errors: Sequence[Array], lag: int) -> float:
    """Sum of products of errors (w, d) in each experiment with those `lag` windows later."""
    total = 0.0  # term by term: Python's own sum rounds differently from 3.12 on
    for own in errors:
        total += float(np.sum(own[lag:] * own[: max(len(own) - lag, 0)]))
    return total
