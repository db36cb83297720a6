"""The tasks of a Dask cluster that are not at a worker."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from simbias.engine.contract import MOST_LOSSES, WorkerLostError, WorkplaceError

if TYPE_CHECKING:
    from distributed import KilledWorker

REFUSED = "simbias: a trial %s. Other workers are preferred from now on"


class TaskQueue:
    """The tasks that are not at a worker, by index.

    Dask blames a worker's death on all tasks that waited there, so a task that lost its workers runs alone at
    the end before it is blamed. A worker at which a task could not begin gets no more tasks while there are
    other workers.
    """

    def __init__(self, size: int) -> None:
        self._waiting, self._suspects = deque(range(size)), deque[int]()
        self._losses, self._refusals = Counter[int](), Counter[int]()
        self._refused: set[str] = set()  # workers at which a task could not begin

    def __bool__(self) -> bool:
        return bool(self._waiting or self._suspects)

    def ready(self, alone: bool) -> bool:
        """Whether a task may run: a suspect only when no other runs (`alone`)."""
        if alone and not self._waiting and self._suspects:
            self._waiting.append(self._suspects.popleft())
        return bool(self._waiting)

    def take(self, workers: Sequence[str]) -> tuple[int, list[str]]:
        """A task, and those of the workers that it should run at; none of them if it may run at any."""
        preferred = [each for each in workers if each not in self._refused] if self._refused else []
        return self._waiting.popleft(), preferred

    def lost(self, index: int, error: KilledWorker) -> WorkerLostError | None:
        """Take back a task whose workers died, or blame it if it ran alone."""
        alone = self._losses[index] >= MOST_LOSSES - 1
        self._losses[index] += error.allowed_failures + 1
        if alone:
            last = error.last_worker.address
            return WorkerLostError(f"its worker died {self._losses[index]} times, the last at {last}")
        (self._waiting if self._losses[index] < MOST_LOSSES - 1 else self._suspects).append(index)
        return None

    def refused(self, index: int, error: WorkplaceError) -> WorkplaceError | None:
        """Take back a task that could not begin at its worker, or blame it after several."""
        if error.worker not in self._refused:
            logging.getLogger(__name__).warning(REFUSED, error)
        self._refused.add(error.worker)
        self._refusals[index] += 1
        if self._refusals[index] >= MOST_LOSSES:
            return error
        self._waiting.append(index)
        return None
