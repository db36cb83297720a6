"""Worker processes of this machine."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import cache, partial
from typing import Any

from pydantic import PositiveInt

from simbias.engine.rounds import RoundBrokenError, call, until_done
from simbias.interfaces import Engine, R, T, WorkerLostError

WATCH_SECONDS = 1.0


class Loky(Engine):
    """joblib's processes: robust to workers that are killed, one thread of numerical libraries each.

    Parameters
    ----------
    n_jobs
        Worker processes; with 1, trials run in this one.
    """

    def __init__(self, n_jobs: PositiveInt = 2) -> None:
        self.n_jobs = n_jobs

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Yield indices and results as tasks end."""
        return until_done(partial(self._round, function), tasks)

    def _round(
        self, function: Callable, calls: Iterable[tuple[int, Any]], alone: bool
    ) -> Iterator[tuple[int, Any]]:
        """Results of the calls, until a worker dies."""
        from joblib import Parallel, delayed, parallel_config

        warnings.filterwarnings(
            "ignore", message="A worker stopped while some jobs"
        )  # replaced: it had grown
        worker = delayed(partial(_in_worker, os.getpid(), function))
        with parallel_config("loky", n_jobs=self.n_jobs, inner_max_num_threads=1):
            parallel = Parallel(
                return_as="generator_unordered", batch_size=1, pre_dispatch="1" if alone else "2*n_jobs"
            )
            results = parallel(worker(index, task) for index, task in calls)
        try:
            yield from results
        except BrokenProcessPool as error:
            raise RoundBrokenError(_reason(error)) from error
        except BaseException:  # interrupted: do not wait for trials
            _kill_workers()
            raise


def _reason(error: BaseException) -> str:
    """What loky says of a dead worker, in short."""
    lines = [line.strip() for line in str(error).splitlines() if "exit codes" in line]
    return lines[0] if lines else type(error).__name__


def _kill_workers() -> None:
    """End the workers at once."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=False, kill_workers=True)


def _in_worker(parent: int, function: Callable[[T], R], index: int, task: T) -> tuple[int, R]:
    """Run a task in a worker that ends with its parent, and leaves Ctrl-C to it."""
    if os.getpid() != parent:
        _follow(parent)
    return call(function, index, task)


@cache
def _follow(parent: int) -> None:
    """Once in a worker: end it when its parent has ended, however that ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
