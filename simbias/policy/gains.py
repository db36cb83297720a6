"""How gains are searched (Eq. 10)."""

from __future__ import annotations

import numpy as np

from simbias.records import Array


def signed_exponential(h: Array) -> Array:
    """Gains of the parameters h-hat (Eq. 10): large and small ones of both signs."""
    return np.sign(h) * np.expm1(np.abs(h))
