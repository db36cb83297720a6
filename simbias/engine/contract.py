"""The contract of engines: where the trials of a sweep run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

from simbias.core.errors import ConfigError

T = TypeVar("T")
R = TypeVar("R")

MOST_LOSSES = 3  # of a task's worker, until the task is blamed


class WorkerLostError(RuntimeError):
    """A worker died with its task, repeatedly."""


class WorkplaceError(WorkerLostError):
    """A task cannot begin at its worker, but perhaps at another."""

    def __init__(self, problem: str, worker: str = "") -> None:
        super().__init__(problem, worker)
        self.problem, self.worker = problem, worker

    def __str__(self) -> str:
        return f"cannot begin at {self.worker or 'its worker'}: {self.problem}"


class EngineLostError(ConfigError):
    """The scheduler was lost before all tasks had ended; the same command resumes."""


Results = Generator[tuple[int, R | WorkerLostError], None, None]  # a task's index, and its result


class Engine(ABC):
    """Runs the trials of a sweep."""

    shares_disk: bool = True  # whether all workers see the files of this process
    has_workers: bool = True  # whether trials run in other processes, which may be killed

    @abstractmethod
    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Results[R]:
        """Yield (index of a task, function(task)) as tasks end, in any order, every task once.

        `function` is a module-level function that raises only a WorkplaceError, if no disk is shared. A task
        runs again if its worker died or it could not begin there; after repeated failures, its
        WorkerLostError is yielded. Tasks can be pickled. `code` packs the user's own code and files for
        workers without a shared disk; it is empty if there are none. Closing the generator stops the workers.
        """
