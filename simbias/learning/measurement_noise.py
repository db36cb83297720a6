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


@dataclass(frozen=True, eq=False)
class MeasurementNoise:
    """White noise in measured states: at the start of each window, and in the chunk means compared with."""

    starts: Array  # (n,) variances of a window's first state
    means: Array  # (n,) variances of chunk means

    @staticmethod
    def of(errors: Array, weights: Array, linearisation: Linearisation, floor: Array) -> MeasurementNoise:
        """The noise that best explains errors (w, d), by expectation maximisation.

        The squares of the deviations `floor` (d,) are added to the variances, which are never smaller.
        """
        F = linearisation.by_start
        d, n = F.shape[1:]
        observed = np.concatenate([errors[:, :, None], linearisation.by_parameters], axis=2)
        observed *= np.sqrt(weights)[:, None, None]
        variance_floor = floor.reshape(-1, n)[0] ** 2
        R = np.mean(np.sum(observed**2, axis=2), axis=0).reshape(-1, n).mean(axis=0) / 2 + variance_floor
        P = R.copy()
        for _ in range(ROUNDS):
            of_starts, remaining = _moments(F, observed, P, np.tile(R, d // n))
            P = of_starts.mean(axis=0) + variance_floor
            R = remaining.mean(axis=0).reshape(-1, n).mean(axis=0) + variance_floor
        return MeasurementNoise(P, R)

    def covariance(self, linearisation: Linearisation) -> Array:
        """Covariance (d, d) of window errors due to this noise, on average over the windows."""
        w, d, n = linearisation.by_start.shape
        flat = (linearisation.by_start * np.sqrt(self.starts)).transpose(1, 0, 2).reshape(d, -1)
        return flat @ flat.T / w + np.diag(np.tile(self.means, d // n))

    def excess(self, scores: Array, weights: Array, linearisation: Linearisation, spread: Array) -> Array:
        """A root (p, p) of the part of a gradient's covariance that average windows do not explain.

        The gradient is the sum over windows of scores (p, w, d) times errors with weights (w,). Noise at the
        start has more effect in some windows than in others. If these also have larger scores, the average
        effect is too small. Directions in which it is too large are ignored. A root `spread` (p, p) of the
        parameters' covariance sets the coordinates of these directions.
        """
        white = np.einsum("qp,qwd->pwd", spread, scores)
        F = linearisation.by_start * np.sqrt(self.starts * weights[:, None])[:, None, :]
        each = np.einsum("pwd,wdn->pwn", white, F).reshape(len(white), -1)
        mean = np.einsum("wdn,wen->de", F, F, optimize=True) / len(F)
        average = np.einsum("pwd,qwd->pq", white @ mean, white, optimize=True)
        excess, directions = np.linalg.eigh(each @ each.T - average)
        return np.linalg.solve(spread.T, directions * np.sqrt(np.maximum(excess, 0.0)))


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
