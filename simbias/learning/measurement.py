"""What noise in measured states does to errors of predictions over windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simbias.core.records import Array

ROUNDS = 30  # of expectation maximisation, from the last scale that was found


@dataclass(frozen=True, eq=False)
class Linearised:
    """Predictions over w windows of d = J n numbers, to first order."""

    starts: Array  # derivatives (w, d, n) by the state in which a window begins
    doubts: Array  # (w, d, p) by standard normal variables, which say how uncertain parameters are

    @staticmethod
    def of(by_start: Array, doubts: Array) -> Linearised:
        """From derivatives (w, J, n, n) and (w, J, n, p); what is no number counts as zero."""
        w, J, n, _ = by_start.shape
        flat = (each.reshape(w, J * n, each.shape[3]) for each in (by_start, doubts))
        return Linearised(*(np.nan_to_num(each, nan=0.0, posinf=0.0, neginf=0.0) for each in flat))

    def doubt(self, weights: Array) -> Array:
        """Covariance (d, d) of the errors that uncertain parameters hide: the mode fits them away."""
        flat = (
            (np.sqrt(weights)[:, None, None] * self.doubts)
            .transpose(1, 0, 2)
            .reshape(self.doubts.shape[1], -1)
        )
        return flat @ flat.T / len(weights)


def covariance_of_noise(errors: Array, weights: Array, linearised: Linearised, least: Array) -> Array:
    """Covariance (d, d), averaged over the windows, of the noise that explains errors (w, d) best.

    In each window, noise of variances P is in the state that it begins with, and noise of variances R in the
    means that it is compared with. Both are found by expectation maximisation.
    """
    F = linearised.starts
    w, d, n = F.shape
    seen = np.concatenate([errors[:, :, None], linearised.doubts], axis=2) * np.sqrt(weights)[:, None, None]
    floor = least.reshape(-1, n)[0] ** 2
    R = np.mean(np.sum(seen**2, axis=2), axis=0).reshape(-1, n).mean(axis=0) / 2 + floor
    P = R.copy()
    for _ in range(ROUNDS):
        G = F / np.tile(R, d // n)[:, None]
        M = np.linalg.inv(np.diag(1.0 / P) + F.transpose(0, 2, 1) @ G)  # (w, n, n)
        a = M @ (G.transpose(0, 2, 1) @ seen)
        P = np.mean(np.sum(a**2, axis=2) + np.diagonal(M, axis1=1, axis2=2), axis=0) + floor
        left = np.sum((seen - F @ a) ** 2, axis=2) + np.einsum("wdn,wnm,wdm->wd", F, M, F)
        R = left.mean(axis=0).reshape(-1, n).mean(axis=0) + floor
    flat = (F * np.sqrt(P)).transpose(1, 0, 2).reshape(d, -1)
    return flat @ flat.T / w + np.diag(np.tile(R, d // n))
