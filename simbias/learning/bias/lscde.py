"""Least-squares conditional density estimation of the residuals, without assuming Gaussian transitions."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field
from threadpoolctl import threadpool_limits

from simbias.core import Bias, FittedBias, Kernel, Task
from simbias.core.ranges import Count, Positive
from simbias.core.records import Array, Flags, Indices, Transitions
from simbias.learning.bias.gp_kernel import coordinates_of, correlations, means, pack
from simbias.learning.bias.none import ZeroBias
from simbias.learning.covariance import FAR, correlation, hyperparameters, output_scale
from simbias.simulation.compiler import LANES

Candidates = Annotated[list[Positive], Field(min_length=1)]
SEED = 0  # of centres and folds, so that the same data give the same bias
NOTHING = 1e-3  # of the largest weight, added to p(x): far from all data the mean is zero


class LeastSquaresDensity(Bias):
    """A conditional density p(y | x) for each state, fitted by least squares (Sugiyama et al., IEICE 2010).

    Tangkaratt et al. (Neural Networks 57, 2014) learn transition models this way. The ratio p(x, y) / p(x) is
    a sum of Gaussian kernels at b of the samples, with closed-form weights. Width and regularisation, shared
    by all states, minimise the cross-validated squared error. The simulation adds the mean.

    Parameters
    ----------
    task
        Provides the input limits, by which inputs are scaled.
    kernels
        b, at most; the number of kernels.
    widths
        Candidates for sigma, with inputs divided by their deviation and residuals by their root mean square.
    regularisations
        Candidates for lambda.
    folds
        Number of cross-validation folds.
    """

    def __init__(
        self,
        task: Task,
        kernels: Count = 100,
        widths: Candidates = [0.3, 0.6, 1.0, 2.0],  # noqa: B006 (read only)
        regularisations: Candidates = [1e-3, 1e-2, 1e-1],  # noqa: B006
        folds: Annotated[int, Field(ge=2, le=100)] = 5,
    ) -> None:
        self._hyper = hyperparameters(task, 1.0, 1.0, 1.0, 1.0, None)
        self._kernels, self._folds = kernels, folds
        self._candidates = [(width, each) for width in widths for each in regularisations]

    @threadpool_limits.wrap(limits=1, user_api="blas")  # for small matrices, threads cost more than they save
    def fit(self, transitions: Transitions) -> FittedBias:
        """Fit a density to each state's residuals; zero bias with fewer samples than folds."""
        N, n = transitions.residuals.shape
        if self._folds > N:
            return ZeroBias(n)
        deviation = transitions.inputs.std(axis=0)
        units = 1 / np.where(deviation > 0, deviation, self._hyper.input_scale)
        scale = np.where(size := output_scale(transitions.residuals), size, 1.0)
        x, y = transitions.inputs * units, transitions.residuals / scale
        centre = np.where(np.abs(x.mean(axis=0)) > FAR, x.mean(axis=0), 0.0)
        x = x - centre
        order = np.random.default_rng(SEED).permutation(N)
        chosen, folds = order[: self._kernels], order % self._folds

        def error(candidate: tuple[float, float]) -> float:
            own = [self._error(x, y, chosen, folds == fold, *candidate) for fold in range(self._folds)]
            return float(np.sum(own))  # Python's own sum rounds differently from 3.12 on

        width, regularisation = min(self._candidates, key=error)
        H, h = _moments(x, y, x[chosen], y[chosen], width)
        weights = _weights(H, h, regularisation)
        return FittedDensity(x[chosen], y[chosen], weights, width, units, centre, scale)

    def _error(
        self, x: Array, y: Array, chosen: Indices, own: Flags, width: float, regularisation: float
    ) -> float:
        """Squared error of densities, up to a constant, on held-out samples."""
        weights = _weights(*_moments(x[~own], y[~own], x[chosen], y[chosen], width), regularisation)
        H, h = _moments(x[own], y[own], x[chosen], y[chosen], width)
        return float(np.einsum("il,ilk,ik", weights, H, weights) / 2 - np.sum(h * weights))


def _moments(x: Array, y: Array, u: Array, v: Array, width: float) -> tuple[Array, Array]:
    """H (n, b, b), the mean over x of the integral over y of phi phi^T, and h (n, b), the mean of phi."""
    near = correlation(x / width, u / width)
    overlap = np.sqrt(np.pi) * width * np.exp(-((v[:, None] - v) ** 2) / (4 * width**2))  # (b, b, n)
    bumps = np.exp(-((y[:, None] - v) ** 2) / (2 * width**2))  # (N, b, n)
    H = np.moveaxis(overlap, -1, 0) * (near.T @ near) / len(x)
    return H, np.einsum("kl,kli->il", near, bumps) / len(x)


def _weights(H: Array, h: Array, regularisation: float) -> Array:
    """The least-squares weights (n, b), with negative ones set to zero."""
    regular = H + regularisation * np.eye(H.shape[-1])
    return np.maximum(np.linalg.solve(regular, h[..., None])[..., 0], 0.0)


def _correct(x, u, data, correction):
    """The means, for states x (n, LANES) under u (m, LANES)."""
    points, sums, inverse_scale, centre, floors, scale, angles = data
    n = x.shape[0]
    both = means(sums, correlations(coordinates_of(x, u, inverse_scale, centre, angles), points), 2 * n)
    for lane in range(LANES):
        for i in range(n):
            correction[i, lane] = scale[i] * both[i, lane] / (both[n + i, lane] + floors[i])


class FittedDensity(FittedBias):
    """p(y | x) = sum_l a_l K(x, u_l) N(y; v_l, sigma^2) / sum_l a_l K(x, u_l), of each state."""

    def __init__(
        self, u: Array, v: Array, weights: Array, width: float, units: Array, centre: Array, scale: Array
    ) -> None:
        self._u, self._v = u, v  # (b, r), (b, n): centres
        self._weights, self._width = weights, width  # (n, b)
        self._units, self._centre, self._scale = units, centre, scale  # (r,), (r,) of inputs; (n,)
        self._floors = NOTHING * weights.max(axis=1, initial=1e-12)
        points, sums = (u / width).astype(np.float32), np.concatenate([weights * v.T, weights])
        scales = units / width, centre / width, self._floors, scale
        data = (points, pack(sums), *scales, np.empty(0, np.int64))
        self.kernel = Kernel(_correct, data)

    def density(self, inputs: Array, values: Array, state: int) -> Array:
        """p(y | x) (k, l) of one state's residual at raw inputs (k, n+m), for values (l,)."""
        size = self._width * self._scale[state]
        bumps = np.exp(-((values[:, None] - self._scale[state] * self._v[:, state]) ** 2) / (2 * size**2))
        return self._shares(inputs)[state] @ bumps.T / (np.sqrt(2 * np.pi) * size)

    def _shares(self, inputs: Array) -> Array:
        """Shares (n, k, b) of the kernels in p(y | x); the remainder to one belongs to a zero residual."""
        near = correlation((inputs * self._units - self._centre) / self._width, self._u / self._width)
        near = self._weights[:, None] * near
        return near / (near.sum(axis=-1, keepdims=True) + self._floors[:, None, None])

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Mean (k, n) and variance (k, n) of the residual at raw inputs (k, n+m)."""
        shares = self._shares(inputs)
        mean = np.einsum("ikl,li->ki", shares, self._v)
        variance = np.einsum("ikl,li->ki", shares, self._v**2) - mean**2 + self._width**2
        return mean * self._scale, variance * self._scale**2

    def correction(self, x: Array, u: Array) -> Array:
        """The mean (..., n) at x (..., n), u (..., m)."""
        inputs = np.concatenate([x, u], axis=-1)
        return self.predict(inputs.reshape(-1, inputs.shape[-1]))[0].reshape(x.shape)
