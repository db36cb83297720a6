"""Replay of a trial's earlier steps; new steps are kept before they are used."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.records import Optimum
from simbias.lab.checked_hardware import ExperimentRecord


class EndOfRecord(Exception):  # noqa: N818 (no error: the end of what was recorded)
    """A trial that is only being read has no further step."""


class Record(ExperimentRecord):
    """The steps of a trial in their order."""

    @abstractmethod
    def search(self, make: Callable[[], Optimum]) -> Optimum:
        """The next search: replayed, or made and kept."""


class ReplayedOptimizer(Optimizer):
    """An optimizer whose searches are run only once, then replayed."""

    def __init__(self, optimizer: Optimizer, record: Record) -> None:
        self._optimizer = optimizer
        self._record = record
        self.max_evaluations = optimizer.max_evaluations
        self.relative_tolerance = optimizer.relative_tolerance
        self.max_steps, self.max_seconds = optimizer.max_steps, optimizer.max_seconds

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search as the optimizer does."""
        return self._optimizer.search(evaluations, rng)

    def minimize(self, *arguments: Any, **options: Any) -> Optimum:
        """The optimum of the search, replayed if it was found before."""
        return self._record.search(partial(self._optimizer.minimize, *arguments, **options))
