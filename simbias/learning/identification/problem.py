"""The mode and the spread of parameters, for a given distribution of prediction errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares

from simbias.core import Nominal
from simbias.core.parameters import Parameter, values_at
from simbias.core.records import Array, Indices
from simbias.learning.measurement_noise import Linearisation
from simbias.learning.prediction_errors import FREEDOM, ErrorDistribution
from simbias.simulation.open_loop import PredictionModel, Windows, predict

Differences = Literal["forward", "central"]

STEP = 1e-4  # of finite differences: in a coordinate, or relative to the standard deviation of a state
LEAST_DEVIATION = 1e-9  # added to the standard deviation of a state
SPREAD_ROUNDS = 2  # for estimating the errors' covariance, including the part removed by fitting


def coordinates_of(parameters: Sequence[Parameter], recordings: Indices) -> Indices:
    """Indices (r, parameters) of the coordinates of r experiments, each a piece of one recording (r,).

    The first recording's coordinates come first, then the specific ones of each other recording.
    """
    p, own = len(parameters), np.flatnonzero([parameter.of_recording for parameter in parameters])
    places = np.tile(np.arange(p), (len(recordings), 1))
    for place, recording in zip(places, recordings.tolist(), strict=True):
        if recording:
            place[own] = p + (recording - 1) * len(own) + np.arange(len(own))
    return places


class WindowErrors:
    """Errors of predictions over recorded windows of one duration, for a given error covariance.

    Coordinates z (p,) are the first recording's, then the specific ones of each other recording.
    """

    errors: ErrorDistribution  # estimated by `at`

    def __init__(self, nominal: Nominal, windows: Windows, predict: Callable[..., Array] = predict) -> None:
        self._nominal = nominal
        self._windows = windows
        self._predict = predict
        self._observed = windows.means
        own = windows.recordings
        self._recordings = np.arange(len(windows.frames)) if own is None else own
        self.places = coordinates_of(nominal.parameters, self._recordings)  # (r, parameters)

    @property
    def size(self) -> int:
        """The number p of coordinates."""
        return int(self.places.max(initial=-1)) + 1

    @staticmethod
    def at(nominal: Nominal, windows: Windows, z: Array, freedom: float) -> WindowErrors:
        """The window errors with their covariance estimated at coordinates z (p,)."""
        made = WindowErrors(nominal, windows)
        made.errors = ErrorDistribution.of(made.prediction_errors(z[None])[0], windows, freedom)
        return made

    def residuals(self, z: Array, differences: Differences = "forward") -> tuple[Array, Array]:
        """Residuals (w d,), whose squares sum to the loss, and their Jacobian (w d, p) with respect to z."""
        white, J, weights = self._weighted(z, differences)
        losses = self.errors.independent_share * self.errors.losses(white)
        size = np.sum(white**2, axis=1)
        ratio = np.divide(losses, size, out=weights.copy(), where=size > 0)  # tends to the weights at 0
        scale = np.sqrt(ratio)
        slope = weights / scale
        return (scale[:, None] * white).ravel(), (slope[:, None] * J).reshape(len(z), -1).T

    def _weighted(self, z: Array, differences: Differences) -> tuple[Array, Array, Array]:
        """White errors (w, d), derivatives with respect to z (p, w, d), and weights (w,) of windows."""
        white = self.errors.whiten(self.prediction_errors(_around(z, differences)))
        weights = self.errors.independent_share * self.errors.weights(white[0])
        return white[0], _slopes(white, len(z)), weights

    def scatter(self, z: Array, differences: Differences) -> Callable[[Array], Array]:
        """A function: from a root (p, p) of the covariance of z to one (p, k) of the gradient's.

        Central differences account for measurement noise that has more effect in some windows than in others.
        """
        p, windows, around = len(z), self._windows, _around(z, differences)
        steps = STEP * (np.std(windows.states, axis=0) + LEAST_DEVIATION)
        n = len(steps)
        each = self._predictions(
            np.vstack([around, np.tile(z, (n, 1))]), np.vstack([np.zeros((len(around), n)), np.diag(steps)])
        )
        made, moved = each[: len(around)], each[len(around) :]
        by_start = np.moveaxis((moved - made[0]) / steps[:, None, None, None], 0, -1)
        errors = made - self._observed
        white = self.errors.whiten(errors)
        J = _slopes(white, p)  # (p, w, d)
        by_parameters = np.moveaxis(_slopes(made, p), 0, -1)
        root = np.sqrt(self.errors.independent_share * self.errors.weights(white[0]))[:, None]

        def across(spread: Array) -> Array:
            linearisation = Linearisation.of(by_start, by_parameters @ spread)
            estimate = ErrorDistribution.of(errors[0], windows, FREEDOM, linearisation)
            ratio = np.linalg.solve(self.errors.factor, estimate.factor)
            scattered = (root * (J @ ratio)).reshape(p, -1)
            if differences == "forward" or estimate.noise is None:
                return scattered
            own = estimate.weights(estimate.whiten(errors[0]))
            scores = root * (J @ self.errors.inverse)
            return np.hstack([scattered, estimate.noise.excess(scores, own, linearisation, spread)])

        return across

    def coordinates(self, mode_of: Callable[[int], Array]) -> Array:
        """Coordinates (p,) of an identified model, given those of each recording by its number."""
        z = np.empty(self.size)
        for place, recording in zip(self.places, self._recordings.tolist(), strict=True):
            z[place] = mode_of(recording)
        return z

    def shift(self, z: Array, difference: Array) -> Array:
        """How far (p,) the mode z moves, to first order, if predictions change by `difference` (w, J, n)."""
        _, J, weights = self._weighted(z, "central")
        weighted = (weights[:, None] * J).reshape(len(z), -1)
        precision = weighted @ J.reshape(len(z), -1).T + np.eye(len(z))
        return np.asarray(-np.linalg.solve(precision, weighted @ self.errors.whiten(difference).ravel()))

    def prediction_errors(self, z: Array) -> Array:
        """Errors (k, w, J, n) with the parameters at coordinates z (k, p)."""
        no_offsets = np.zeros((len(z), self._windows.states.shape[1]))
        return self._predictions(z, no_offsets) - self._observed

    def _predictions(self, z: Array, offsets: Array) -> Array:
        """Means (k, w, J, n) over chunks at coordinates z (k, p), from starts offset by (k, n)."""
        if self.size == self.places.shape[1]:  # no recording-specific parameters, or only one recording
            return self._predict(self._models(z, offsets), self._windows)
        windows = self._windows
        of_each = [
            replace(windows, firsts=windows.firsts[[i]], leads=windows.leads[[i]], frames=windows.frames[[i]])
            for i in range(len(self.places))
        ]
        made = [
            self._predict(self._models(z[:, places], offsets), each)
            for places, each in zip(self.places, of_each, strict=True)
        ]
        return np.concatenate(made, axis=1)

    def _models(self, z: Array, offsets: Array) -> list[PredictionModel]:
        """Models at coordinates (k, parameters), from starts offset by (k, n)."""
        values = values_at(self._nominal.parameters, z)
        pairs = zip(values, offsets, strict=True)
        return [PredictionModel(self._nominal.with_parameters(v), off) for v, off in pairs]


class Information:
    """Fisher information about coordinates z (p,) in windows, if z were the truth.

    The models around z are made once: compiling a model takes longer than predicting windows.
    """

    def __init__(self, nominal: Nominal, z: Array) -> None:
        values = values_at(nominal.parameters, _around(z, "central"))
        self._models = [PredictionModel(nominal.with_parameters(each)) for each in values]

    def of(self, windows: Windows, errors: ErrorDistribution) -> Array:
        """The information (p, p) in windows, for a given error covariance."""
        white = errors.whiten(predict(self._models, windows) - windows.means)
        p = len(self._models) // 2
        J = _slopes(white, p).reshape(p, -1)
        return errors.independent_share * J @ J.T


class Problem:
    """Nonlinear least squares for the mode.

    Windows of several durations share the same data, so their log-likelihoods are averaged, weighted by the
    number of windows (a composite likelihood: C. Varin, N. Reid, D. Firth, Statistica Sinica 21, 2011). The
    covariances of errors are estimated at coordinates z (p,).
    """

    def __init__(self, nominal: Nominal, windows: Sequence[Windows], z: Array, freedom: float) -> None:
        self._comparisons = [WindowErrors.at(nominal, each, z, freedom) for each in windows]
        counts = np.array([len(each) for each in windows])
        self._weights = np.sqrt(counts / counts.sum())  # of residuals
        self.places, self.errors = self._comparisons[0].places, self._comparisons[0].errors
        self._last: tuple[tuple[bytes, Differences], Array, Array] | None = None

    def mode(self, z: Array, evaluations: int) -> Array:
        """The most probable coordinates, searched from z."""
        residuals, derivatives = (lambda at: self._at(at)[0]), (lambda at: self._at(at)[1])
        return least_squares(residuals, z, derivatives, ftol=1e-5, xtol=1e-4, max_nfev=evaluations).x

    def precision(self, z: Array) -> Array:
        """Curvature (p, p) of the negative log-density at z, by the Jacobian of the residuals."""
        J = self._at(z)[1]
        return J.T @ J

    def spread(self, z: Array, differences: Differences = "forward") -> Array:
        """A square root (p, p) of the covariance of the mode z: H^-1 (I + G) H^-1, with the precision H.

        G is the covariance of the log-density's gradient under the estimated error covariance; H uses the
        covariance that weights the errors (V. P. Godambe, Annals of Mathematical Statistics 31, 1960). For
        several durations, G is the mean, an upper bound on the covariance of the mean gradient.

        By the Jacobian of the residuals, H is smaller than the expected curvature: 0.72 times at errors of
        the usual size. Deviations that the data determine are therefore up to 1.4 times too wide if windows
        have nothing but such errors. Other effects make them too narrow (`results/identify_coverage`).
        """
        p = len(z)
        spread = solve_triangular(qr(self._at(z, differences)[1], mode="economic")[1], np.eye(p))
        H, scatters = spread @ spread.T, [each.scatter(z, differences) for each in self._comparisons]
        for _ in range(SPREAD_ROUNDS):
            across = [w * scatter(spread) for w, scatter in zip(self._weights, scatters, strict=True)]
            scattered = H @ np.hstack([np.eye(p), *across])
            spread = qr(scattered.T, mode="economic")[1].T
        return spread

    def _at(self, z: Array, differences: Differences = "forward") -> tuple[Array, Array]:
        """Residuals (R + p,), the prior's last, and their derivatives with respect to z (p,)."""
        key = z.tobytes(), differences
        if self._last is None or self._last[0] != key:
            made = [each.residuals(z, differences) for each in self._comparisons]
            weighted = [(w * r, w * J) for w, (r, J) in zip(self._weights, made, strict=True)]
            residuals = np.concatenate([*(r for r, _ in weighted), z])
            derivatives = np.concatenate([*(J for _, J in weighted), np.eye(len(z))])
            self._last = key, residuals, derivatives
        return self._last[1], self._last[2]


def _around(z: Array, differences: Differences) -> Array:
    """Coordinates (k, p): z, a step along each coordinate and, for central differences, one back."""
    steps = np.eye(len(z) + 1, len(z), -1)
    return z + STEP * (steps if differences == "forward" else np.vstack([steps, -steps[1:]]))


def _slopes(values: Array, p: int) -> Array:
    """Derivatives (p, ...) from values (k, ...) at the coordinates of `_around`."""
    ahead, back = values[1 : p + 1], values[p + 1 :]
    return (ahead - back) / (2 * STEP) if len(back) else (ahead - values[0]) / STEP
