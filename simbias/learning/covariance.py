"""Hyper-parameters, covariance and factorisation of a Gaussian process (Section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cholesky

from simbias.core import Task
from simbias.core.records import Array

FINEST = 1e-6  # of the signal's variance: the least noise; single precision resolves no less
FAR = 100.0  # length scales from zero; farther away, single-precision coordinates are too coarse


@dataclass(frozen=True)
class Hyperparameters:
    """theta of Section IV-B, and d of Eq. 7; variances of residuals relative to their mean square."""

    input_scale: Array  # (r,) in the task's units
    length_scale: Array  # (r,) of the scaled inputs; the diagonal of Lambda is its square
    signal_variance: float  # alpha^2
    noise_variance: float  # sigma^2
    d: float
    angles: tuple[int, ...] = ()  # columns of raw inputs that enter as sine and cosine; then r > n + m
    linear: float = 0.0  # prior deviation of the coefficients of an added linear function; 0: none
    centre: Array | float = 0.0  # (r,) of scaled coordinates

    @property
    def prior_variance(self) -> float:
        """k(x, x) with its noise (Eq. 3)."""
        return self.signal_variance + self.noise_variance

    def coordinates(self, inputs: Array) -> Array:
        """Raw inputs (k, n+m) as (k, r): sines replace angles, and their cosines are appended."""
        if not self.angles:
            return inputs
        angles = list(self.angles)
        sines = inputs.copy()
        sines[:, angles] = np.sin(inputs[:, angles])
        return np.concatenate([sines, np.cos(inputs[:, angles])], axis=1)

    def scale(self, inputs: Array) -> Array:
        """Raw inputs (k, n+m) as coordinates (k, r) relative to the centre, in units of the length scales."""
        return self.coordinates(inputs) / (self.input_scale * self.length_scale) - self.centre

    def centred(self, inputs: Array) -> Hyperparameters:
        """A copy centred on raw inputs (k, n+m), if they are far from the centre or a function is linear."""
        mean = np.mean(self.scale(inputs), axis=0) if len(inputs) else np.zeros(len(self.length_scale))
        moved = (np.abs(mean) > FAR) | (self.linear > 0)
        return replace(self, centre=self.centre + np.where(moved, mean, 0.0))

    def basis(self, scaled: Array) -> Array:
        """Basis (k, p) of linear functions at scaled inputs (k, r): inputs divided by `input_scale`, and 1.

        p is r + 1, or 0 without a linear function.
        """
        if not self.linear:
            return np.empty((len(scaled), 0))
        return np.column_stack([scaled * self.length_scale, np.ones(len(scaled))])

    def covariance(self, a: Array, b: Array) -> Array:
        """Latent covariance (k, l) of scaled inputs (k, r) and (l, r): Eq. 3 without its noise."""
        return self.signal_variance * correlation(a, b)


def correlation(a: Array, b: Array) -> Array:
    """exp(-|a - b|^2 / 2) (k, l) for the rows of a (k, r) and b (l, r)."""
    with np.errstate(over="ignore", invalid="ignore"):  # a simulated state may overflow
        squared = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T
        return np.exp(-0.5 * np.maximum(squared, 0.0))


def hyperparameters(
    task: Task,
    length_scale: float | Sequence[float],
    signal_variance: float,
    noise_variance: float,
    d: float,
    input_scale: Sequence[float] | None,
    periodic: bool = False,
    linear: float = 0.0,
) -> Hyperparameters:
    """Hyper-parameters for a task; by default inputs are scaled by their limits, states by 1.

    If `periodic`, states that wrap enter as sine and cosine, both with the state's scales.

    Raises
    ------
    ValueError
        If a list does not have one value for each state and input, an input has neither scale nor limit, or
        the noise is less than single precision resolves.
    """
    r = len(task.states) + len(task.inputs)
    if noise_variance < FINEST * signal_variance:
        raise ValueError(f"noise_variance: expected at least {FINEST:g} times signal_variance")
    if input_scale is None:
        for each, limit in zip(task.inputs, task.input_limit.tolist(), strict=True):
            if not np.isfinite(limit):
                raise ValueError(f"{each.name} has no limit to scale by: declare one, or a GP's input_scale")
        input_scale = [1.0] * len(task.states) + list(task.input_limit)
    for name, values in (("length_scale", length_scale), ("input_scale", input_scale)):
        if not isinstance(values, float | int) and len(values) != r:
            raise ValueError(f"{name} has {len(values)} values; the task has {r} states and inputs")
    lengths = np.broadcast_to(np.array(length_scale, dtype=np.float64), r)
    scales = np.array(input_scale, dtype=np.float64)
    angles = tuple(i for i, state in enumerate(task.states) if periodic and state.wraps)
    if others := [task.states[i] for i in angles if task.states[i].unit != "rad"]:
        raise ValueError(f"periodic: expected angles in rad, got {others[0].name} in {others[0].unit}")
    both = [*range(r), *angles]
    return Hyperparameters(scales[both], lengths[both], signal_variance, noise_variance, d, angles, linear)


def output_scale(residuals: Array) -> Array:
    """Root mean square (n,) of residuals (N, n), the unit of their variances; 1 without data."""
    return np.sqrt(np.mean(residuals**2, axis=0)) if len(residuals) else np.ones(residuals.shape[1])


def stable_cholesky(K: Array) -> Array:
    """Lower Cholesky factor of K (N, N), with the least jitter of 0, 1e-12, 1e-10, ... that makes it exist.

    Raises
    ------
    LinAlgError
        If K is far from positive definite.
    """
    if not len(K):
        return K
    scale = np.mean(np.diag(K))
    for jitter in (0.0, *10.0 ** np.arange(-12, -1, 2)):
        try:
            return cholesky(K + jitter * scale * np.eye(len(K)), lower=True)
        except LinAlgError:
            continue
    raise LinAlgError("the covariance of the training data is not positive definite")
