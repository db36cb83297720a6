"""The parametrisation of gains in a search (Eq. 10)."""

from __future__ import annotations

import numpy as np

from simbias.core.records import Array

TINY = 1e-12  # size of a feature that is always zero
RCOND = 1e-10  # relative cut-off for features of unit size


def signed_exponential(h: Array) -> Array:
    """Gains from the parameters h-hat (Eq. 10): large and small ones of both signs."""
    return np.sign(h) * np.expm1(np.abs(h))


def inverse_signed_exponential(gains: Array) -> Array:
    """The parameters h-hat from gains (Eq. 10)."""
    return np.sign(gains) * np.log1p(np.abs(gains))


def least_squares_gains(features: Array, inputs: Array) -> Array:
    """Gains (r,) of the least-squares fit of features (k, T, r) to inputs (k, T), of minimum norm."""
    rows = features.reshape(-1, features.shape[-1])
    size = np.sqrt(np.mean(rows**2, axis=0)) + TINY
    return np.linalg.lstsq(rows / size, inputs.ravel(), rcond=RCOND)[0] / size
