"""How gains are searched (Eq. 10)."""

from __future__ import annotations

import numpy as np

from simbias.core.records import Array

TINY = 1e-12  # size of a feature that is never there
RCOND = 1e-10  # of features of unit size


def signed_exponential(h: Array) -> Array:
    """Gains of the parameters h-hat (Eq. 10): large and small ones of both signs."""
    return np.sign(h) * np.expm1(np.abs(h))


def inverse_signed_exponential(gains: Array) -> Array:
    """The parameters h-hat of gains (Eq. 10)."""
    return np.sign(gains) * np.log1p(np.abs(gains))


def least_squares_gains(features: Array, inputs: Array) -> Array:
    """Gains (r,) by which features (k, T, r) come nearest to inputs (k, T); nearly dependent ones share."""
    rows = features.reshape(-1, features.shape[-1])
    size = np.sqrt(np.mean(rows**2, axis=0)) + TINY
    return np.linalg.lstsq(rows / size, inputs.ravel(), rcond=RCOND)[0] / size
