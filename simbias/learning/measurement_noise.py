"""The covariance of window prediction errors due to noise in measured states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.core.records import Array, Flags

ROUNDS = 30  # of expectation maximisation


@dataclass(frozen=True, eq=False)
class Linearisation:
    """First-order predictions over w windows, each of J chunk means of n states: d = J n numbers."""

    by_start: Array  # (w, d, n) derivatives with respect to a window's first state
    by_parameters: Array  # (w, d, p) derivatives with respect to standard normal parameter coordinates

    @staticmethod
    def of(by_start: Array, by_parameters: Array) -> Linearisation:
        """Flatten derivatives (w, J, n, n) and (w, J, n, p); non-finite ones become zero."""
        w, J, n, _ = by_start.shape
        flat = (each.reshape(w, J * n, each.shape[3]) for each in (by_start, by_parameters))
        return Linearisation(*(np.nan_to_num(each, nan=0.0, posinf=0.0, neginf=0.0) for each in flat))

    def of_windows(self, chosen: Flags) -> Linearisation:
        """The linearisation of the chosen windows (w,) only."""
        return Linearisation(self.by_start[chosen], self.by_parameters[chosen])

    def parameter_covariance(self, weights: Array) -> Array:
        """Covariance (d, d) of the errors removed by fitting the parameters; weights (w,) of windows."""
        weighted = np.sqrt(weights)[:, None, None] * self.by_parameters
        flat = weighted.transpose(1, 0, 2).reshape(weighted.shape[1], -1)
        return flat @ flat.T / len(weights)


def noise_covariance(errors: Array, weights: Array, linearisation: Linearisation, floor: Array) -> Array:
    """Covariance (d, d) of errors due to the measurement noise that best explains errors (w, d).

    Noise with variances P (n,) acts on a window's first state; noise with variances R (n,) acts on the chunk
    means that are compared with predictions. Expectation maximisation estimates both. Neither falls below the
    square of the deviations `floor` (d,).
    """
    F = linearisation.by_start
    w, d, n = F.shape
    observed = np.concatenate([errors[:, :, None], linearisation.by_parameters], axis=2)
    observed *= np.sqrt(weights)[:, None, None]
    variance_floor = floor.reshape(-1, n)[0] ** 2
    R = np.mean(np.sum(observed**2, axis=2), axis=0).reshape(-1, n).mean(axis=0) / 2 + variance_floor
    P = R.copy()
    for _ in range(ROUNDS):
        of_starts, remaining = _moments(F, observed, P, np.tile(R, d // n))
        P = of_starts.mean(axis=0) + variance_floor
        R = remaining.mean(axis=0).reshape(-1, n).mean(axis=0) + variance_floor
    flat = (F * np.sqrt(P)).transpose(1, 0, 2).reshape(d, -1)
    return flat @ flat.T / w + np.diag(np.tile(R, d // n))


def _moments(F: Array, observed: Array, P: Array, R: Array) -> tuple[Array, Array]:
    """Second moments (w, n) of starts, and (w, d) of errors (w, d, k) without them, given P (n,), R (d,)."""
    G = F / R[:, None]
    try:
        M = np.linalg.inv(np.diag(1.0 / P) + F.transpose(0, 2, 1) @ G)  # (w, n, n)
    except np.linalg.LinAlgError:
        return _moments_of_directions(F, observed, P, R)
    a = M @ (G.transpose(0, 2, 1) @ observed)
    of_starts = np.sum(a**2, axis=2) + np.diagonal(M, axis1=1, axis2=2)
    return of_starts, np.sum((observed - F @ a) ** 2, axis=2) + np.einsum("wdn,wnm,wdm->wd", F, M, F)


def _moments_of_directions(F: Array, observed: Array, P: Array, R: Array) -> tuple[Array, Array]:
    """The same by singular values, for robots so unstable that predictions determine a single direction."""
    noise, scale = np.sqrt(R)[:, None], np.sqrt(P)
    U, s, V = np.linalg.svd(F * scale / noise, full_matrices=False)
    told = (U.transpose(0, 2, 1) @ (observed / noise)) * (s / (1.0 + s**2))[:, :, None]
    root = scale[:, None] * V.transpose(0, 2, 1) / np.sqrt(1.0 + s**2)[:, None]
    starts = scale[:, None] * (V.transpose(0, 2, 1) @ told)
    of_starts = np.sum(starts**2, axis=2) + np.sum(root**2, axis=2)
    predicted = noise * (U @ (s[:, :, None] * told))
    spread = noise * U * (s / np.sqrt(1.0 + s**2))[:, None]
    return of_starts, np.sum((observed - predicted) ** 2, axis=2) + np.sum(spread**2, axis=2)
