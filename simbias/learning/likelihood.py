"""Hyper-parameters learned as the mode of the marginal likelihood times log-normal priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, cholesky

from simbias.core.ranges import Count, Spread
from simbias.core.records import Array, Transitions
from simbias.learning.covariance import Hyperparameters, correlation, output_scale

LEAST_NOISE = 1e-4  # of the signal's variance: resolution of the compiled kernel's single precision
ROUNDING = 2.0**-22  # of a state's deviation: smaller residuals are rounding in single precision
LEAST_SCALE = 1e-12  # least scale of residuals, in their units, for a state that does not move
REACH = 10.0  # prior deviations that bound the search; beyond, distances may be mere rounding


@dataclass(frozen=True)
class HyperPriors:
    """Standard deviations of the priors of the hyper-parameters' logarithms; 0 keeps the median."""

    length_scale: Spread = 1.0  # 1: one standard deviation is a factor e
    signal_variance: Spread = 1.0
    noise_ratio: Spread = 1.0  # of noise to signal variance
    points: Count = 200  # maximum number, evenly spaced in the data


def learn(medians: Hyperparameters, transitions: Transitions, learning: HyperPriors) -> Hyperparameters:
    """The most probable length scales, signal variance and ratio of noise to signal, given the data.

    All outputs share them, each divided by its root mean square; outputs that are mere rounding are ignored.
    The search starts from the medians; rough data may have another, more probable mode. Deterministic;
    without data, the medians.
    """
    return mode(medians, transitions, learning)[0]


def mode(
    medians: Hyperparameters, transitions: Transitions, learning: HyperPriors
) -> tuple[Hyperparameters, float]:
    """Hyper-parameters as in `learn`, and the log of marginal likelihood times priors at them.

    The log-density is in nats, for residuals in their units, up to a constant, so models with different
    residuals can be compared. Residuals that are mere rounding count as white noise of that size.
    """
    from scipy.optimize import Bounds, minimize  # lazily: most trials learn none

    N = len(transitions)
    chosen = np.linspace(0, N - 1, min(N, learning.points)).astype(int)
    scale = output_scale(transitions.residuals)
    states = transitions.inputs[:, : len(scale)]
    rounding = np.maximum(ROUNDING * (states.std(axis=0) if N else 0.0), LEAST_SCALE)  # (n,)
    varying = scale > rounding
    centred, inputs = medians.centred(transitions.inputs), transitions.inputs[chosen]
    far = replace(medians, linear=0.0).centred(transitions.inputs).centre * medians.length_scale
    x = medians.coordinates(inputs) / medians.input_scale - far  # otherwise distances would be rounding
    basis = medians.linear * centred.basis(centred.scale(inputs))
    y = transitions.residuals[chosen][:, varying] / scale[varying]
    noise_ratio = medians.noise_variance / medians.signal_variance
    centre = np.log([*medians.length_scale, medians.signal_variance, noise_ratio])
    deviation = np.append(
        np.full(x.shape[1], learning.length_scale), [learning.signal_variance, learning.noise_ratio]
    )
    kept = deviation == 0
    precision = 1 / np.where(kept, np.inf, deviation)
    lower = np.append(np.full(len(centre) - 1, -np.inf), np.log(LEAST_NOISE))
    bounds = Bounds(np.where(kept, centre, lower), np.where(kept, centre, np.inf))

    nearest, farthest = centre - REACH * deviation, centre + REACH * deviation

    def loss(theta: Array) -> tuple[float, Array]:
        reached = np.clip(theta, nearest, farthest)
        log_likelihood, gradient = log_marginal_likelihood(reached, x, y, basis @ basis.T)
        z = (theta - centre) * precision
        return float(0.5 * z @ z) - log_likelihood, z * precision - np.where(reached == theta, gradient, 0.0)

    found = minimize(loss, centre, jac=True, method="L-BFGS-B", bounds=bounds)
    *length_scale, signal_variance, noise_ratio = np.exp(found.x)
    hyper = replace(
        medians,
        length_scale=np.array(length_scale),
        signal_variance=float(signal_variance),
        noise_variance=float(signal_variance * noise_ratio),
    )
    of_units = np.sum(np.log(np.maximum(scale, rounding)))
    of_rounding = 0.5 * np.log(2 * np.pi * np.e) * np.sum(~varying)
    return hyper, -float(found.fun + len(y) * (of_units + of_rounding))


def log_marginal_likelihood(
    theta: Array, x: Array, y: Array, K_linear: Array | float = 0.0
) -> tuple[float, Array]:
    """ln p(y | x, theta) of outputs y (N, n) at inputs x (N, r), and its gradient (r+2,).

    K_linear (N, N) is the prior covariance of an added linear function.

    theta (r+2,) are the logarithms of the length scales, of alpha^2 and of sigma^2 / alpha^2
    (Rasmussen and Williams, Gaussian Processes for Machine Learning, Eq. 5.8 and 5.9).
    """
    *length_scale, signal_variance, noise_ratio = np.exp(theta)
    noise_variance = signal_variance * noise_ratio
    z = x / length_scale
    K_latent = signal_variance * correlation(z, z)
    N, n = y.shape
    L = cholesky(K_latent + K_linear + noise_variance * np.eye(N), lower=True)
    K_inverse = cho_solve((L, True), np.eye(N))
    weights = K_inverse @ y
    value = -0.5 * np.sum(y * weights) - n * np.sum(np.log(np.diag(L))) - 0.5 * n * N * np.log(2 * np.pi)
    dK = 0.5 * (weights @ weights.T - n * K_inverse)  # d value / d K
    from_signal = dK * K_latent
    from_noise = noise_variance * np.trace(dK)
    from_lengths = 2 * (from_signal.sum(axis=1) @ z**2 - np.sum(z * (from_signal @ z), axis=0))
    return float(value), np.array([*from_lengths, from_signal.sum() + from_noise, from_noise])
