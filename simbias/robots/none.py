"""No model: f' = 0, so that the whole dynamics is learned from data."""

from __future__ import annotations

from simbias.core import Nominal
from simbias.core.records import Array


class NoNominal(Nominal):
    """Predicts that nothing changes: f' = 0 in Eq. 2, so that g_D is learned from scratch (Section IV-A)."""

    def step(self, x: Array, u: Array) -> Array:
        """X_next (..., n) = x (..., n)."""
        return x.copy()
