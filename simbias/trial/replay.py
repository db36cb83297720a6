"""Steps that a trial has made are replayed; those that it makes are kept before anyone uses them."""

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


class EndOfRecord(Exception):  # noqa: N818 (no error: as far as a trial came)
    """A trial that is only read has made no further step."""


class Record(ExperimentRecord):
    """The steps of a trial in their order."""

    @abstractmethod
    def search(self, make: Callable[[], Optimum]) -> Optimum:
        """The next search: replayed, or made and kept."""


class ReplayedOptimizer(Optimizer):
    """An optimizer each of whose searches is made but once."""

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
        """The optimum, or the one that was found in its place before."""
        return self._record.search(partial(self._optimizer.minimize, *arguments, **options))
