"""No identification: the nominal model as declared."""

from __future__ import annotations

from collections.abc import Sequence

from simbias.core import Identification, Nominal
from simbias.core.records import Rollout


class NoIdentification(Identification):
    """Keeps the declared parameters."""

    def fit(self, nominal: Nominal, rollouts: Sequence[Rollout]) -> Nominal:
        """The nominal model itself."""
        return nominal
