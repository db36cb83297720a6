"""The contract of engines: where the trials of a sweep run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

from simbias.core.errors import ConfigError

T = TypeVar("T")
R = TypeVar("R")

MOST_LOSSES = 3  # of a task's worker, until the task is to blame


class WorkerLostError(RuntimeError):
    """A worker died with its task, again and again."""


class WorkplaceError(WorkerLostError):
    """A task cannot begin at its worker; at another one it may."""

    def __init__(self, problem: str, worker: str = "") -> None:
        super().__init__(problem, worker)
        self.problem, self.worker = problem, worker

    def __str__(self) -> str:
        return f"cannot begin at {self.worker or 'its worker'}: {self.problem}"


class EngineLostError(ConfigError):
    """The scheduler of the tasks is gone before they have ended; the same command resumes."""


Results = Generator[tuple[int, R | WorkerLostError], None, None]  # a task's index, and its result


class Engine(ABC):
    """Runs the trials of a sweep."""

    shares_disk: bool = True  # whether all workers see the files of this process

    @abstractmethod
    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Results[R]:
        """Yield (index of a task, function(task)) as tasks end, in any order, every task once.

        `function` is one of a module's and raises nothing but, where no disk is shared, a WorkplaceError. A
        task whose worker died, or at which it cannot begin, runs again; one that has no luck each time yields
        the WorkerLostError. Tasks can be pickled. `code` packs the user's own code and files, for workers
        that share no disk; empty if there is none. Closing the generator stops the workers.
        """
