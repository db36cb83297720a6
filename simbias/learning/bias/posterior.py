"""Gaussian-process posteriors (Section IV-B to IV-D): exact, sparse with inducing points, and samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np
from scipy.linalg import solve_triangular

from simbias.core import FittedBias, Kernel
from simbias.core.records import Array, Transitions
from simbias.learning.bias.gp_kernel import correct, pack, pack_triangle
from simbias.learning.bias.inducing import Inducing, choose, view
from simbias.learning.covariance import Hyperparameters, output_scale, stable_cholesky
from simbias.simulation.compiler import constant

ROWS = 32
MOST_COMPARED = 2000  # samples; with more, a sparse posterior is not compared with the exact one (cost N^3)


@dataclass(frozen=True, eq=False)
class Trend:
    """The posterior of b in y = b^T h(x) + g(x), with g a Gaussian process and h (p,) a linear basis.

    The prior of b is normal; its standard deviation is `Hyperparameters.linear` times the root mean square of
    the output. Given b, g is the process of y - b^T h, with weights W - G b (C. E. Rasmussen, C. K. I.
    Williams, Gaussian Processes for Machine Learning, Section 2.7). Without data b is zero.
    """

    mean: Array  # (p, n) of b
    root: Array  # (p, p) R, where R^T R is the covariance of b relative to each output's mean square
    G: Array  # (N, p) the process's weights if each basis function were an output

    @staticmethod
    def learned(
        hyper: Hyperparameters, inputs: Array, y: Array, solve: Callable[[Array], tuple[Array, Array]]
    ) -> Trend:
        """From outputs y (k, n) at scaled inputs (k, r); `solve` gives weights (N, n) and K^-1 y (k, n)."""
        H = hyper.basis(inputs)
        G, of_basis = solve(H)
        if not H.size:
            return Trend(np.zeros((H.shape[1], y.shape[1])), np.zeros((H.shape[1],) * 2), G)
        precision = H.T @ of_basis + np.eye(H.shape[1]) / hyper.linear**2
        root = solve_triangular(stable_cholesky(precision), np.eye(len(precision)), lower=True)
        return Trend(root.T @ (root @ (of_basis.T @ y)), root, G)

    @staticmethod
    def none(points: int, outputs: int) -> Trend:
        """No linear function, for a process of this many points."""
        return Trend(np.empty((0, outputs)), np.empty((0, 0)), np.empty((points, 0)))


@final
@dataclass(eq=False)
class GPPosterior(FittedBias):
    """A posterior for each state; all share inputs and hyper-parameters, and thus one factorisation.

    With k the covariance of a new input and the N points, the means are k^T W (Eq. 4), and the variance is
    k(x, x) - |U k|^2 (Eq. 5), in units of each output's mean square. U is a lower triangle, for all points or
    for the first ones. An optional linear function is added to each mean, and is not weighted in Eq. 7.
    """

    hyper: Hyperparameters
    scale: Array  # (n,) of the outputs
    points: Array  # (N, r), scaled
    U: Array  # (M, M), M <= N
    W: Array  # (N, n)
    R: Array  # (m, N), R^T R is the covariance of a draw's weights, given its waves
    L_inverse: Array  # (m, N), L_inverse^T L_inverse waves(points): weights that offset its waves
    trend: Trend
    features: int = 0  # number of Fourier features of a draw
    diagnostics: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        d_n = self.hyper.d * self.W.shape[1]
        self.kernel = _compiled(self.hyper, self.points, self.W, self.U, d_n, self.trend.mean)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) (Eq. 4) and variance (k, n), noise included (Eq. 5), at raw inputs (k, n+m)."""
        scaled = self.hyper.scale(inputs)
        k_star = self.hyper.covariance(scaled, self.points)
        mean, variance = self._given_trend(k_star)
        basis = self.hyper.basis(scaled)
        of_trend = basis - k_star @ self.trend.G
        variance = variance + np.sum((of_trend @ self.trend.root.T) ** 2, axis=1)
        return mean + basis @ self.trend.mean, variance[:, None] * self.scale**2

    def relative(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n), and variance (k,) relative to each output's mean square, given the linear function."""
        return self._given_trend(self.hyper.covariance(self.hyper.scale(inputs), self.points))

    def _given_trend(self, k_star: Array) -> tuple[Array, Array]:
        """The same, from covariances k_star (k, N) of inputs with the points."""
        known = np.sum((k_star[:, : len(self.U)] @ self.U.T) ** 2, axis=1)
        return k_star @ self.W, self.hyper.prior_variance - known

    def weight(self, variance: Array) -> Array:
        """The weight of the mean in Eq. 7; |sigma_t|^2 sums the relative variances of the n outputs."""
        return np.exp(-self.hyper.d * self.W.shape[1] * variance)

    def correction(self, x: Array, u: Array) -> Array:
        """The last term (..., n) of Eq. 7 at x (..., n), u (..., m)."""
        return _row_by_row(self._weighted, x, u)

    def _weighted(self, inputs: Array) -> Array:
        """The mean (k, n) at raw inputs (k, n+m), times its weight in Eq. 7, plus the linear function."""
        mean, variance = self.relative(inputs)
        linear = self.hyper.basis(self.hyper.scale(inputs)) @ self.trend.mean
        return self.weight(variance)[:, None] * mean + linear

    def draw(self, rng: np.random.Generator) -> GPSample:
        """A sample of the latent values at the inducing points.

        Away from these points it returns to zero like the mean: neither the conditional variance k(x, x) -
        k^T K_ZZ^-1 k nor the noise is sampled. The size of the sampled variations depends on the
        hyper-parameters: learned ones reflect the error of the mean, those of Table I only the distance from
        the data.

        With Fourier features, the conditional variance is sampled too: a function from the prior minus its
        prediction from its values at the inducing points (J. Wilson et al., Efficiently Sampling Functions
        from Gaussian Process Posteriors, ICML 2020). Over many draws, mean and variance of the values equal
        those of the posterior at any input, for any number of features. Without data the sample is zero.
        """
        e = rng.standard_normal((len(self.R), len(self.scale)))
        weights = self.W + self.scale * (self.R.T @ e)
        deviation = self.scale * (self.trend.root.T @ rng.standard_normal(self.trend.mean.shape))
        weights -= self.trend.G @ deviation
        trend = self.trend.mean + deviation
        if not self.features or not len(self.points):
            return GPSample(self.hyper, self.points, weights, trend=trend)
        waves = Waves.drawn(self.hyper, self.features, self.scale, rng)
        weights -= self.L_inverse.T @ (self.L_inverse @ waves(self.points))
        return GPSample(self.hyper, self.points, weights, waves, trend)


@dataclass(frozen=True, eq=False)
class Waves:
    """A function of scaled inputs, a sum of cosines: a GP's prior by random Fourier features.

    A. Rahimi, B. Recht, Random Features for Large-Scale Kernel Machines, NIPS 2007.
    """

    frequencies: Array  # (F, r), in rad
    phases: Array  # (F,) in rad
    amplitudes: Array  # (F, n)

    @staticmethod
    def drawn(hyper: Hyperparameters, features: int, scale: Array, rng: np.random.Generator) -> Waves:
        """Cosines and sines, with frequencies from the spectrum of Eq. 3; outputs in units of scale (n,)."""
        frequencies = np.tile(rng.standard_normal((features, len(hyper.length_scale))), (2, 1))
        phases = np.repeat([0.0, -np.pi / 2], features)
        size = np.sqrt(hyper.signal_variance / features) * scale
        return Waves(frequencies, phases, size * rng.standard_normal((2 * features, len(scale))))

    @staticmethod
    def none(r: int, n: int) -> Waves:
        """The zero function."""
        return Waves(np.empty((0, r)), np.empty(0), np.empty((0, n)))

    def __call__(self, scaled: Array) -> Array:
        """Values (k, n) at scaled inputs (k, r)."""
        return np.cos(scaled @ self.frequencies.T + self.phases) @ self.amplitudes


@final
class GPSample(FittedBias):
    """A function k^T W drawn from a posterior, with optional waves and linear function (p, n).

    Its weight in Eq. 7 is one: samples already differ where data are scarce, so a smaller weight there would
    count the same uncertainty twice.
    """

    def __init__(
        self,
        hyper: Hyperparameters,
        points: Array,
        W: Array,
        waves: Waves | None = None,
        trend: Array | None = None,
    ) -> None:
        self._hyper = hyper
        self._points = points  # (N, r), scaled
        self._W = W  # (N, n)
        self._waves = waves
        self._trend = np.empty((0, W.shape[1])) if trend is None else trend
        self.kernel = _compiled(hyper, points, W, np.empty((0, 0)), 0.0, self._trend, waves)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """The function's values (k, n), and zero variances (k, n)."""
        scaled = self._hyper.scale(inputs)
        values = self._hyper.covariance(scaled, self._points) @ self._W
        values += self._hyper.basis(scaled) @ self._trend
        if self._waves is not None:
            values += self._waves(scaled)
        return values, np.zeros_like(values)

    def correction(self, x: Array, u: Array) -> Array:
        """The function's value (..., n) at x (..., n), u (..., m)."""
        return _row_by_row(lambda inputs: self.predict(inputs)[0], x, u)


def _row_by_row(function: Callable[[Array], Array], x: Array, u: Array) -> Array:
    """Apply a function of inputs (k, n+m) at x (..., n), u (..., m), each row independent of the others.

    BLAS chooses its order of summation by matrix size, so all calls use ROWS rows.
    """
    inputs = np.concatenate([x, u], axis=-1)
    rows = inputs.reshape(-1, inputs.shape[-1])
    if not len(rows):
        return np.empty_like(x)
    padded = np.pad(rows, ((0, -len(rows) % ROWS), (0, 0)), mode="edge")
    values = np.concatenate([function(padded[first : first + ROWS]) for first in range(0, len(padded), ROWS)])
    return values[: len(rows)].reshape(*x.shape[:-1], -1)


def _compiled(
    hyper: Hyperparameters,
    points: Array,
    W: Array,
    U: Array,
    d_n: float,
    trend: Array,
    waves: Waves | None = None,
) -> Kernel:
    """The compiled correction in single precision; zero without points."""
    if not len(points):
        return constant(np.zeros(W.shape[1]))
    waves = waves or Waves.none(points.shape[1], W.shape[1])
    turns = np.column_stack([waves.frequencies, waves.phases]) / (2 * np.pi)
    linear = (trend.T * [*hyper.length_scale, 1.0]) if len(trend) else np.empty((0, 1))
    data = (
        points.astype(np.float32),
        pack_triangle(U),
        pack(W.T),
        len(U),
        1.0 / (hyper.input_scale * hyper.length_scale),
        hyper.centre + np.zeros(points.shape[1]),
        np.array([hyper.signal_variance, hyper.prior_variance, d_n]),
        np.array(hyper.angles, np.int64),
        turns.astype(np.float32),
        pack(waves.amplitudes.T),
        linear.astype(np.float32),
    )
    return Kernel(correct, data)


def exact(hyper: Hyperparameters, transitions: Transitions, features: int = 0) -> GPPosterior:
    """The posterior given all data: U = L^-1, W = K^-1 y, K = L L^T.

    Without Fourier features, its draws vary only at inducing points: at most 200 of the data.
    """
    hyper = hyper.centred(transitions.inputs)
    points = hyper.scale(transitions.inputs)
    K = hyper.covariance(points, points)
    K[np.diag_indices_from(K)] += hyper.noise_variance
    L = stable_cholesky(K)
    L_inverse = solve_triangular(L, np.eye(len(L)), lower=True)

    def solve(y: Array) -> tuple[Array, Array]:
        """Weights, here K^-1 y."""
        weights = solve_triangular(L, solve_triangular(L, y, lower=True), lower=True, trans="T")
        return weights, weights

    trend = Trend.learned(hyper, points, transitions.residuals, solve)
    W = solve(transitions.residuals)[0] - trend.G @ trend.mean
    scale = output_scale(transitions.residuals)
    if features:  # weights K^-1 (y - waves - noise), for all points
        R, of_drawn = np.sqrt(hyper.noise_variance) * (L_inverse.T @ L_inverse), L_inverse
    else:
        chosen, _ = choose(hyper, points, Inducing())
        seen = view(hyper, points, chosen)
        R, of_drawn = np.zeros((2, len(chosen), len(points)))
        R[:, chosen], of_drawn[:, chosen] = seen.R, seen.L_inverse
    return GPPosterior(hyper, scale, points, L_inverse, W, R, of_drawn, trend, features)


def sparse(
    hyper: Hyperparameters, transitions: Transitions, inducing: Inducing, features: int
) -> GPPosterior:
    """The sparse posterior of Titsias (AISTATS 2009, Eq. 6): all data, represented by inducing points Z.

    With S = (K_ZZ + K_ZX K_XZ / sigma^2)^-1, W = S K_ZX y / sigma^2 and U^T U = K_ZZ^-1 - S; for U, Z has
    fewer points. The diagnostics are the largest differences from the exact posterior at training inputs: of
    the mean (in units of the residuals' root mean square) and of the weight in Eq. 7.
    """
    hyper = hyper.centred(transitions.inputs)
    points = hyper.scale(transitions.inputs)
    chosen, for_variance = choose(hyper, points, inducing)
    seen = view(hyper, points, chosen)

    def solve(y: Array) -> tuple[Array, Array]:
        """Weights, and K^-1 y with K = K_XZ K_ZZ^-1 K_ZX + sigma^2."""
        weights = seen.R.T @ (seen.R @ (seen.K_ZX @ y)) / hyper.noise_variance
        return weights, (y - seen.K_ZX.T @ weights) / hyper.noise_variance

    trend = Trend.learned(hyper, points, transitions.residuals, solve)
    W = solve(transitions.residuals)[0] - trend.G @ trend.mean
    coarsely = view(hyper, points, chosen[:for_variance])
    C = coarsely.L_inverse.T @ coarsely.L_inverse - coarsely.R.T @ coarsely.R
    U = stable_cholesky(C[::-1, ::-1]).T[::-1, ::-1]  # lower, with U^T U = C
    scale = output_scale(transitions.residuals)
    counts = {"inducing_points": len(chosen), "inducing_points_of_variance": for_variance}
    posterior = GPPosterior(hyper, scale, seen.Z, U, W, seen.R, seen.L_inverse, trend, features, counts)
    if 0 < len(transitions) <= MOST_COMPARED:
        errors = _errors(posterior, exact(hyper, transitions), transitions)
        posterior.diagnostics = {**posterior.diagnostics, **errors}
    return posterior


def _errors(approximate: GPPosterior, reference: GPPosterior, transitions: Transitions) -> dict[str, float]:
    """Largest differences between two posteriors at up to 200 training inputs."""
    inputs = transitions.inputs[:: max(1, len(transitions) // 200)]
    mean, exact_mean = (p.predict(inputs)[0] for p in (approximate, reference))
    variance, exact_variance = (p.relative(inputs)[1] for p in (approximate, reference))
    scale = np.sqrt(np.mean(transitions.residuals**2)) or 1.0
    weights = approximate.weight(variance) - reference.weight(exact_variance)
    return {
        "mean_error": float(np.abs(mean - exact_mean).max() / scale),
        "weight_error": float(np.abs(weights).max()),
    }
