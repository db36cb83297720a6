"""A residual GP learned from windows of experiments, with cross-validated hyper-parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from scipy.linalg import solve_triangular

from simbias.core import Bias, FittedBias, Nominal, Task
from simbias.core.ranges import Count, NonNegative, Positive, Seconds
from simbias.core.records import Array, Indices, Rollout, Transitions
from simbias.learning.bias.inducing import Inducing, choose
from simbias.learning.bias.none import ZeroBias
from simbias.learning.bias.posterior import GPPosterior, GPSample, Trend
from simbias.learning.covariance import Hyperparameters, stable_cholesky
from simbias.learning.noise import robust_deviation
from simbias.learning.prediction_errors import ErrorDistribution, correlation_time
from simbias.simulation.open_loop import PredictionModel, Windows, model_states, predict

LEAST_SIGNAL = 1e-12  # in a state's unit; it would be zero for a state that the model predicts exactly
JITTER = 1e-6  # of the inducing points' covariance, relative to the signal's variance
CANDIDATES = 2000  # inputs among which inducing points are chosen
STEP = 1e-5  # of a state, for finite differences
BATCH = 64  # windows differentiated at once, to bound memory


class WindowGP(Bias):
    """One Gaussian process for each state, learned from windows; length scale and signal by cross-validation.

    The residual of the (identified) nominal model over a window is, to first order, linear in the values of
    the bias along it. Fitting windows instead of single steps averages out measurement noise; the error
    distribution is that of the parameter identification. Segments of the experiments are held out in turn,
    and the length scale and signal that predict them are chosen. If none improves on the nominal model by
    more than one standard error, the bias is zero everywhere.

    Parameters
    ----------
    window, chunks
        Duration of a prediction in s, and the number of its parts whose means are compared.
    length_scales
        Candidates, in standard deviations of the inputs in the data. The shortest that improves the
        prediction is chosen, as its bias vanishes fastest away from the data.
    signals
        Candidates for the standard deviation of the bias, relative to the constant bias that would explain
        the root mean square residual of a window.
    segment, folds
        Duration in s of the held-out segments, and the maximum number of fits.
    points
        Largest number of inducing points.
    d
        Weight of the variance in Eq. 7; a state's variance is relative to that of its prior. 0: the
        unweighted mean.
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
        d: NonNegative = 0.0,
    ) -> None:
        frames = window / task.time_step
        self._chunk = max(1, round(frames / chunks))
        self._window = max(1, round(frames / self._chunk)) * self._chunk
        self._length_scales, self._signals = sorted(length_scales), list(signals)
        self._segment = max(1, round(segment / window))  # windows
        self._folds = folds
        self._points = points
        self._d = d

    def fit(self, transitions: Transitions) -> FittedBias:
        """The zero bias: single transitions are not used."""
        return ZeroBias(transitions.residuals.shape[1])

    def learn(self, transitions: Transitions, rollouts: Sequence[Rollout], nominal: Nominal) -> FittedBias:
        """Learn from the residuals of the nominal model over windows of the rollouts."""
        windows = Windows.of(rollouts, self._window, self._chunk) if rollouts else None
        fold = self._fold(windows) if windows else np.zeros(0, np.int64)
        if not windows or len(np.unique(fold)) < 2:
            return self.fit(transitions)
        residuals = windows.means - predict([PredictionModel(nominal)], windows)[0]
        errors = ErrorDistribution.of(residuals, windows)
        last = residuals[:, -1]
        most = 4.0 * robust_deviation(np.abs(last))  # four robust standard deviations
        unit = np.sqrt(np.mean(np.clip(last, -most, most) ** 2, axis=0)) / self._window
        unit = np.maximum(unit, LEAST_SIGNAL)
        for length in self._length_scales:
            hyper, Z = self._inducing(windows, length, nominal)
            derivatives = sensitivities(nominal, windows, features(hyper, Z))
            fits = _Fits.of(derivatives, residuals, errors, fold, windows.experiments)
            gains = [fits.gain(times * unit) for times in self._signals]
            gain, signal = max(gains), self._signals[int(np.argmax(gains))] * unit
            if gain > 0.0:
                diagnostics = {"gain": gain, "inducing_points": len(Z), "length_scale": length}
                return WindowPosterior(hyper, Z, *fits.posterior(signal), signal, diagnostics)
        return self.fit(transitions)

    def _fold(self, windows: Windows) -> Indices:
        """Index (w,) of the fold of each window, in whose fit it is held out."""
        segments, first = np.empty(len(windows), np.int64), 0
        for experiment in np.unique(windows.experiments):
            own = np.flatnonzero(windows.experiments == experiment)
            segments[own] = first + np.arange(len(own)) // self._segment
            first = segments[own[-1]] + 1
        return segments * min(self._folds, first) // first

    def _inducing(self, windows: Windows, length: float, nominal: Nominal) -> tuple[Hyperparameters, Array]:
        """Hyper-parameters in scales of the data, and scaled inducing points (R, n+m)."""
        rows = (windows.starts[:, None] + np.arange(windows.window)).ravel()
        rows = rows[:: max(1, len(rows) // CANDIDATES)]
        inputs = np.concatenate([windows.states[rows], windows.acted(nominal)[rows]], axis=1)
        scale = np.maximum(np.std(inputs, axis=0), 1e-9)
        hyper = Hyperparameters(scale, np.full(inputs.shape[1], length), 1.0, 0.0, self._d).centred(inputs)
        scaled = hyper.scale(inputs)
        chosen, _ = choose(hyper, scaled, Inducing(self._points, 1e-3, 1e-3))
        return hyper, scaled[chosen]


@dataclass(frozen=True, eq=False)
class _Fits:
    """Linear regression of whitened residuals on feature weights, with posteriors that hold out one fold."""

    A: Array  # (w, J n, n R) weighted, whitened sensitivities
    b: Array  # (w, J n) weighted, whitened residuals
    fold: Indices  # (w,)
    experiments: Indices  # (w,)
    independent_share: float
    products: Array  # (f, n R, n R), A^T A of each fold
    moments: Array  # (f, n R), A^T b of each fold

    @staticmethod
    def of(
        derivatives: Array, residuals: Array, errors: ErrorDistribution, fold: Indices, experiments: Indices
    ) -> _Fits:
        """Weight windows by their residuals (w, J, n) without a bias; derivatives (w, J, n, n R)."""
        b = errors.whiten(residuals)
        weights = np.sqrt(errors.weights(b))
        A = (errors.inverse @ derivatives.reshape(*b.shape, -1)) * weights[:, None, None]
        b = b * weights[:, None]
        folds = range(fold.max() + 1)
        products = np.array([_product(A[fold == f]) for f in folds])
        moments = np.array([np.einsum("wij,wi->j", A[fold == f], b[fold == f]) for f in folds])
        return _Fits(A, b, fold, experiments, errors.independent_share, products, moments)

    def posterior(self, signal: Array, without: int | None = None) -> tuple[Array, Array]:
        """Mean (n R,) and covariance (n R, n R) of the feature weights, optionally without one fold."""
        H, g = self.products.sum(axis=0), self.moments.sum(axis=0)
        if without is not None:
            H, g = H - self.products[without], g - self.moments[without]
        prior = np.repeat(signal**-2.0, len(g) // len(signal))
        covariance = np.linalg.inv(self.independent_share * H + np.diag(prior))
        return self.independent_share * covariance @ g, covariance

    def gain(self, signal: Array) -> float:
        """Mean decrease of the squared errors of held-out windows, minus one standard error."""
        gains = np.empty(len(self.b))
        for f in range(len(self.products)):
            own = self.fold == f
            mean, _ = self.posterior(signal, f)
            left = self.b[own] - self.A[own] @ mean
            gains[own] = np.sum(self.b[own] ** 2, axis=1) - np.sum(left**2, axis=1)
        alike = correlation_time((gains - gains.mean())[:, None], self.experiments)
        return float(gains.mean() - gains.std() * np.sqrt(alike / len(gains)))


def _product(A: Array) -> Array:
    """A^T A of A (w, k, p)."""
    flat = A.reshape(-1, A.shape[2])
    return flat.T @ flat


@final
@dataclass(eq=False)
class WindowPosterior(FittedBias):
    """A bias k(x, Z) K_ZZ^-1/2 W with normal weights W."""

    hyper: Hyperparameters
    Z: Array  # (R, n+m), scaled
    mean: Array  # (n R,) of the weights
    covariance: Array  # (n R, n R)
    signal: Array  # (n,)
    diagnostics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._root = root(self.hyper, self.Z)
        self._function = self._weighted() if self.hyper.d else self._of(self.mean)
        self.kernel = self._function.kernel

    def _of(self, weights: Array) -> GPSample:
        """The bias with feature weights (n R,)."""
        return GPSample(self.hyper, self.Z, self._at_points(weights))

    def _at_points(self, weights: Array) -> Array:
        """Weights (R, n) of the covariances with the inducing points, from feature weights (n R,)."""
        return self._root.T @ weights.reshape(len(self.signal), -1).T

    def _blocks(self) -> list[Array]:
        """Covariances (R, R) of the weights of each state's features."""
        R = len(self.Z)
        return [self.covariance[i : i + R, i : i + R] for i in range(0, len(self.mean), R)]

    def _weighted(self) -> GPPosterior:
        """The mean with its weight in Eq. 7: |sigma_t|^2 sums variances relative to those of the prior."""
        shares = [block / s**2 for block, s in zip(self._blocks(), self.signal, strict=True)]
        values, vectors = np.linalg.eigh(np.eye(len(self.Z)) - np.mean(shares, axis=0))
        A = np.sqrt(np.maximum(values, 0.0))[:, None] * (vectors.T @ self._root)
        U = np.flip(np.linalg.qr(np.flip(A, axis=1))[1])  # lower, with U^T U = A^T A
        W = self._at_points(self.mean)
        none = np.empty((0, len(W)))  # no draws are made from it
        return GPPosterior(self.hyper, self.signal, self.Z, U, W, none, none, Trend.none(*W.shape))

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the bias at raw inputs (k, n+m)."""
        phi = features(self.hyper, self.Z)(inputs)
        known = np.stack([np.sum(phi @ block * phi, axis=1) for block in self._blocks()], axis=1)
        unseen = np.maximum(1.0 - np.sum(phi**2, axis=1), 0.0)
        return self._function.predict(inputs)[0], known + unseen[:, None] * self.signal**2

    def correction(self, x: Array, u: Array) -> Array:
        """The last term (..., n) of Eq. 7 at x (..., n), u (..., m)."""
        return self._function.correction(x, u)

    def draw(self, rng: np.random.Generator) -> FittedBias:
        """A bias drawn from the posterior of the weights."""
        e = stable_cholesky(self.covariance) @ rng.standard_normal(len(self.mean))
        return self._of(self.mean + e)


def root(hyper: Hyperparameters, Z: Array) -> Array:
    """U (R, R) with U^T U the inverse covariance of scaled points Z (R, n+m)."""
    K = hyper.covariance(Z, Z)
    return solve_triangular(stable_cholesky(K + JITTER * np.eye(len(K))), np.eye(len(K)), lower=True)


def features(hyper: Hyperparameters, Z: Array) -> Callable[[Array], Array]:
    """Features (k, R) of inputs (k, n+m); independent unit normal weights give the GP's prior at Z."""
    U = root(hyper, Z)
    return lambda inputs: hyper.covariance(hyper.scale(inputs), Z) @ U.T


def sensitivities(nominal: Nominal, windows: Windows, features: Callable[[Array], Array]) -> Array:
    """Derivatives (w, J, n, n R) of chunk means with respect to the weights of R features of each state.

    They are taken along the nominal model's predictions; features (k, R) are of inputs (k, n+m).
    """
    starts, model_state = windows.starts, model_states(nominal, windows)
    batches = [slice(first, first + BATCH) for first in range(0, len(starts), BATCH)]
    return np.concatenate(
        [_derivatives(nominal, windows, features, starts[some], model_state[some]) for some in batches]
    )


def _derivatives(
    nominal: Nominal,
    windows: Windows,
    features: Callable[[Array], Array],
    starts: Indices,
    model_state: Array,
) -> Array:
    """Derivatives (w, J, n, n R) for the windows that begin at rows `starts` (w,)."""
    x = windows.states[starts]
    w, n = x.shape
    diagonal = np.arange(n)
    S = total = np.zeros((w, n, n, 0))
    means = []
    for t in range(windows.window):
        u = windows.inputs[starts + t]
        shifted = x[:, None] + STEP * np.eye(n)
        advanced, _ = nominal.advance(
            shifted, np.repeat(u[:, None], n, axis=1), np.repeat(model_state[:, None], n, axis=1)
        )
        x_next, model_state = nominal.advance(x, u, model_state)
        phi = features(np.concatenate([x, nominal.acted(u, model_state)], axis=1))
        A = (advanced - x_next[:, None]).transpose(0, 2, 1) / STEP
        if not t:
            S = total = np.zeros((w, n, n, phi.shape[1]))
        S = (A @ S.reshape(w, n, -1)).reshape(S.shape)
        S[:, diagonal, diagonal] += phi[:, None]
        x, total = x_next, total + S
        if (t + 1) % windows.chunk == 0:
            means.append(total / windows.chunk)
            total = np.zeros_like(S)
    return np.stack(means, axis=1).reshape(w, len(means), n, -1)
