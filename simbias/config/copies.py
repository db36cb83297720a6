"""Copies of what Hydra makes and changes, several times as fast as OmegaConf's own."""

from __future__ import annotations

import pickle
from typing import Any


class Copies:
    """As many copies as asked for; they never leave the process."""

    def __init__(self, original: object) -> None:
        self._pickled = pickle.dumps(original)

    def copy(self) -> Any:
        """A copy of one's own."""
        return pickle.loads(self._pickled)
