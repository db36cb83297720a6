"""Worker processes of this machine."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from simbias.core.ranges import Workers
from simbias.engine.contract import MOST_LOSSES, Engine, R, Results, T, WorkerLostError
from simbias.engine.workplace import workplace

WATCH_SECONDS = 1.0
LEAVE_SECONDS = 5.0  # for threads and children of a worker's components to end
NOISE = (  # joblib's messages on replaced or stopped workers, which are handled
    "A worker stopped while some jobs",
    r"\d+ tasks (which were still being processed|have been successfully executed)",
)


class Loky(Engine):
    """joblib's processes: robust to killed workers, with one thread for numerical libraries each.

    Parameters
    ----------
    n_jobs
        Number of worker processes; with 1, trials run in this process.
    """

    def __init__(self, n_jobs: Workers = 2) -> None:
        self.n_jobs = n_jobs
        self.has_workers = n_jobs > 1

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Results[R]:
        """Yield indices and results as tasks end, in rounds: each lasts until a worker dies.

        A task that was running in two broken rounds runs alone from then on, so that no other is blamed.
        """
        rest = dict(enumerate(tasks))
        losses: Counter[int] = Counter()
        while rest:
            batch = [index for index in rest if losses[index] < MOST_LOSSES - 1]
            starts: list[int] = []
            calls = _noted(starts, {index: rest[index] for index in batch or list(rest)[:1]})
            try:
                for index, result in self._round(function, calls, not batch):
                    del rest[index]
                    yield index, result
            except BrokenProcessPool as error:
                losses.update(index for index in starts if index in rest)
                for index in [index for index in rest if losses[index] >= MOST_LOSSES]:
                    del rest[index]
                    yield index, WorkerLostError(f"its worker died {MOST_LOSSES} times: {_reason(error)}")

    def _round(
        self, function: Callable, calls: Iterable[tuple[int, Any]], alone: bool
    ) -> Iterator[tuple[int, Any]]:
        """Results of (index, task) calls; joblib kills the workers when this is closed.

        A call is taken only when it is about to run and, if `alone`, only when no other runs.
        """
        from joblib import Parallel, delayed, load, parallel_config

        for message in NOISE:  # permanently: results are yielded, which a temporary filter would not outlive
            warnings.filterwarnings("ignore", message=message)
        with parallel_config(
            "loky",
            n_jobs=self.n_jobs,
            inner_max_num_threads=1,
            initializer=_follow,
            initargs=(os.getpid(),),
            temp_folder=str(workplace()),
        ):
            parallel = Parallel(
                return_as="generator_unordered", batch_size=1, pre_dispatch="1" if alone else "2*n_jobs"
            )
            results = parallel(delayed(_call)(function, index, task, workplace()) for index, task in calls)
        for index, file in results:
            result = load(file)
            file.unlink()
            yield index, result


def _noted(starts: list[int], tasks: Mapping[int, T]) -> Iterator[tuple[int, T]]:
    """The tasks; the start of each is noted."""
    for index, task in tasks.items():
        starts.append(index)
        yield index, task


def _reason(error: BaseException) -> str:
    """Why a worker died, in short, by loky."""
    lines = [line.strip() for line in str(error).splitlines() if "exit codes" in line]
    return lines[0] if lines else type(error).__name__


def _call(function: Callable[[T], R], index: int, task: T, folder: Path) -> tuple[int, Path]:
    """Run a task in a worker; return its index and the file of its result.

    The result does not go through the workers' pipe: if a worker were killed while writing, joblib would wait
    forever for the rest.
    """
    from joblib import dump, wrap_non_picklable_objects

    file = folder / f"{os.getpid()}-{index}.result"
    dump(wrap_non_picklable_objects(function(task), keep_wrapper=False), file)
    return index, file


def _follow(parent: int) -> None:
    """Make a worker leave Ctrl-C to the parent, and end with it, even if components started threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _in_background(_end_with, parent)
    if sys.platform != "win32":  # which has no forks
        forks = [os.getpid()]
        os.register_at_fork(  # a child would hold the pipes that signal our death
            before=lambda: forks.__setitem__(0, os.getpid()),
            after_in_child=lambda: _in_background(_end_with, forks[0]),
        )
    Finalize(None, lambda: _in_background(_end_after, LEAVE_SECONDS), exitpriority=0)  # Python waits for them


def _end_with(parent: int) -> None:
    """End this process when its parent has ended for any reason."""
    while os.getppid() == parent:
        time.sleep(WATCH_SECONDS)
    os._exit(1)


def _end_after(seconds: float) -> None:
    """End this process after a while."""
    time.sleep(seconds)
    os._exit(0)


def _in_background(function: Callable[[Any], None], argument: Any) -> None:
    """Call a function in a thread that nobody waits for."""
    threading.Thread(target=function, args=(argument,), daemon=True).start()
