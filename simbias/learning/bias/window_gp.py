"""What the nominal model leaves over windows, as far as that predicts what was not fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from scipy.linalg import solve_triangular

from simbias.core import Bias, FittedBias, Nominal, Task
from simbias.core.ranges import Count, Positive, Seconds
from simbias.core.records import Array, Indices, Rollout, Transitions
from simbias.learning.bias.covariance import Hyperparameters, stable_cholesky
from simbias.learning.bias.inducing import Inducing, choose
from simbias.learning.bias.none import NoBias
from simbias.learning.bias.posterior import Drawn
from simbias.learning.bias.sensitivity import Sensitivity
from simbias.learning.prediction_errors import Errors, correlation_time
from simbias.simulation.open_loop import Windows, World, predict

LEAST = 1e-12  # signal, in a state's unit: of a state that the model predicts exactly it would be none
ITSELF = 1e-6  # jitter of the inducing points' covariance, of the signal's variance


class WindowGP(Bias):
    """One Gaussian process for each state; lengths and signal by held-out segments of the experiments.

    What the (identified) nominal model leaves over a window is linear in the functions' values along it, to
    first order. So windows are fitted instead of single steps, in which noise drowns everything, and with
    the same distribution of errors as the parameters. Segments are left out of the fit in turn, and lengths
    and signal taken that predict them well. Where none predicts them better than the nominal model alone, by
    more than the standard error of that, the bias is zero everywhere.

    Parameters
    ----------
    window, chunks
        Duration of a prediction in s; means over so many parts of it are compared.
    length_scales
        Tried from the shortest on, until one gains; of inputs over their standard deviation in the data. What
        is short is zero again soon beyond the data.
    signals
        Tried; the standard deviation of a bias, over that which would make up for the mean square error if
        it were constant over a window.
    segment
        s; the experiments' segments of this duration are left out in turn, but in no more than `folds` fits.
    points
        Inducing points, at most.
    """

    def __init__(
        self,
        task: Task,
        window: Seconds = 0.1,
        chunks: Count = 10,
        length_scales: Sequence[Positive] = (1.0, 2.0, 4.0),
        signals: Sequence[Positive] = (0.3, 1.0, 3.0),
        segment: Seconds = 1.0,
        folds: Count = 5,
        points: Count = 60,
    ) -> None:
        frames = window / task.time_step
        self._chunk = max(1, round(frames / chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk
        self._candidates = [(length, signal) for length in length_scales for signal in signals]
        self._segment = max(1, round(segment / window))  # windows
        self._folds = folds
        self._points = points
        self._none = NoBias()

    def fit(self, transitions: Transitions) -> FittedBias:
        """Zero: single transitions are not learned from."""
        return self._none.fit(transitions)

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from what the nominal model leaves of the rollouts."""
        windows = Windows.of(rollouts, self._window, self._chunk) if rollouts else None
        if not windows:
            return self.fit(transitions)
        fold = self._fold(windows)
        if len(np.unique(fold)) < 2:
            return self.fit(transitions)
        left = windows.means - predict([World(nominal)], windows)[0]
        errors = Errors.of(left, windows)
        signal = np.sqrt(np.mean(np.clip(left[:, -1], *_outliers(left[:, -1])) ** 2, axis=0)) / self._window
        signal = np.maximum(signal, LEAST)
        best: _Candidate | None = None
        for length in sorted({length for length, _ in self._candidates}):
            hyper, Z = self._inducing(windows, length)
            sensitivity = Sensitivity.of(nominal, windows, features(hyper, Z))
            fits = _Fits.of(sensitivity, left, errors, fold, windows.experiments)
            for own, times in self._candidates:
                if own == length:
                    gain = fits.gain(times * signal)
                    if gain > (best.gain if best else 0.0):
                        best = _Candidate(gain, hyper, Z, fits, times * signal)
            if best is not None:
                break
        if best is None:
            return self.fit(transitions)
        mean, covariance = best.fits.posterior(best.signal)
        diagnostics = {
            "gain": best.gain,
            "inducing_points": len(best.Z),
            "length_scale": float(best.hyper.length_scale[0]),
        }
        return OfWindows(best.hyper, best.Z, mean, covariance, best.signal, diagnostics)

    def _fold(self, windows: Windows) -> Indices:
        """Of each window (w,): the fit that it is left out of."""
        segments, first = np.empty(len(windows), np.int64), 0
        for experiment in np.unique(windows.experiments):
            own = np.flatnonzero(windows.experiments == experiment)
            segments[own] = first + np.arange(len(own)) // self._segment
            first = segments[own[-1]] + 1
        return segments * min(self._folds, first) // first

    def _inducing(self, windows: Windows, length: float) -> tuple[Hyperparameters, Array]:
        """Hyper-parameters, and inducing points (R, n+m), scaled, for the data's inputs."""
        rows = (windows.starts[:, None] + np.arange(windows.window)).ravel()
        rows = rows[:: max(1, len(rows) // MOST)]
        inputs = np.concatenate([windows.states[rows], windows.inputs[rows]], axis=1)
        scale = np.maximum(np.std(inputs, axis=0), 1e-9)
        hyper = Hyperparameters(scale, np.full(inputs.shape[1], length), 1.0, 0.0, 0.0)
        scaled = hyper.scale(inputs)
        chosen, _ = choose(hyper, scaled, Inducing(self._points, 1e-3, 1e-3))
        return hyper, scaled[chosen]


MOST = 2000  # inputs among which inducing points are chosen


def _outliers(values: Array) -> tuple[Array, Array]:
    """Beyond which values (k, n) are outliers."""
    most = 4.0 * np.median(np.abs(values), axis=0) / 0.6745
    return -most, most


class _Candidate(NamedTuple):
    """Hyper-parameters that were tried, and what they gain."""

    gain: float
    hyper: Hyperparameters
    Z: Array
    fits: _Fits
    signal: Array


@dataclass(frozen=True, eq=False)
class _Fits:
    """Linear regressions of whitened errors on weights, in which one fold after the other is left out."""

    A: Array  # (w, J n, n R)
    b: Array  # (w, J n)
    fold: Indices  # (w,)
    experiments: Indices  # (w,)
    share: float
    products: Array  # (f, n R, n R), A^T A of each fold
    moments: Array  # (f, n R)

    @staticmethod
    def of(
        sensitivity: Sensitivity, left: Array, errors: Errors, fold: Indices, experiments: Indices
    ) -> _Fits:
        """Weighted as the errors are that there are without a bias."""
        b = errors.whiten(left)
        weights = np.sqrt(errors.weights(b))
        A = sensitivity.whiten(errors) * weights[:, None, None]
        b = b * weights[:, None]
        folds = range(fold.max() + 1)
        products = np.array([_product(A[fold == f]) for f in folds])
        moments = np.array([np.einsum("wij,wi->j", A[fold == f], b[fold == f]) for f in folds])
        return _Fits(A, b, fold, experiments, errors.share, products, moments)

    def posterior(self, signal: Array, without: int | None = None) -> tuple[Array, Array]:
        """Mean (n R,) and covariance (n R, n R) of the weights, but for a fold that is left out."""
        H, g = self.products.sum(axis=0), self.moments.sum(axis=0)
        if without is not None:
            H, g = H - self.products[without], g - self.moments[without]
        prior = np.repeat(signal**-2.0, len(g) // len(signal))
        covariance = np.linalg.inv(self.share * H + np.diag(prior))
        return self.share * covariance @ g, covariance

    def gain(self, signal: Array) -> float:
        """By how much less the squared errors of held-out windows are, on average.

        It is the lower end of an interval of one standard error: positive only beyond chance.
        """
        gains = np.empty(len(self.b))
        for f in range(len(self.products)):
            own = self.fold == f
            mean, _ = self.posterior(signal, f)
            gains[own] = np.sum(self.b[own] ** 2, axis=1) - np.sum(
                (self.b[own] - self.A[own] @ mean) ** 2, axis=1
            )
        alike = correlation_time((gains - gains.mean())[:, None], self.experiments)
        return float(gains.mean() - gains.std() * np.sqrt(alike / len(gains)))


def _product(A: Array) -> Array:
    """A^T A of A (w, k, p)."""
    flat = A.reshape(-1, A.shape[2])
    return flat.T @ flat


@final
class OfWindows(FittedBias):
    """Functions k(x, Z) K_ZZ^-1/2 W, W normal."""

    def __init__(
        self,
        hyper: Hyperparameters,
        Z: Array,
        mean: Array,
        covariance: Array,
        signal: Array,
        diagnostics: dict[str, float],
    ) -> None:
        self._hyper, self._Z, self._signal = hyper, Z, signal
        self._mean, self._covariance = mean, covariance  # (n R,), (n R, n R)
        self._root = root(hyper, Z)
        self._function = self._of(mean)
        self.kernel = self._function.kernel
        self.diagnostics = diagnostics

    def _of(self, weights: Array) -> Drawn:
        """The function of these weights (n R,)."""
        W = self._root.T @ weights.reshape(len(self._signal), -1).T
        return Drawn(self._hyper, self._Z, W)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the functions at raw inputs (k, n+m)."""
        n = len(self._signal)
        phi = features(self._hyper, self._Z)(inputs)
        R = phi.shape[1]
        blocks = [self._covariance[i * R : (i + 1) * R, i * R : (i + 1) * R] for i in range(n)]
        known = np.stack([np.sum(phi @ block * phi, axis=1) for block in blocks], axis=1)
        unseen = np.maximum(1.0 - np.sum(phi**2, axis=1), 0.0)
        return self._function.predict(inputs)[0], known + unseen[:, None] * self._signal**2

    def correction(self, x: Array, u: Array) -> Array:
        """The mean (..., n) at x (..., n), u (..., m)."""
        return self._function.correction(x, u)

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """Functions from the posterior of the weights."""
        e = stable_cholesky(self._covariance) @ rng.standard_normal(len(self._mean))
        return self._of(self._mean + e)


def root(hyper: Hyperparameters, Z: Array) -> Array:
    """U (R, R) with U^T U the inverse of the covariance of points Z (R, n+m), scaled."""
    K = hyper.covariance(Z, Z)
    return solve_triangular(stable_cholesky(K + ITSELF * np.eye(len(K))), np.eye(len(K)), lower=True)


def features(hyper: Hyperparameters, Z: Array) -> Callable[[Array], Array]:
    """Features (k, R) of inputs (k, n+m), whose weights are independent a priori."""
    U = root(hyper, Z)
    return lambda inputs: hyper.covariance(hyper.scale(inputs), Z) @ U.T
