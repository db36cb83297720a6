"""Compiled loops on all threads."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise

import numpy as np
from numba import get_num_threads

from simbias.core.records import Indices
from simbias.simulation.compiler.kernels import LANES


def in_threads(run: Callable[[int, int, Indices], object], count: int) -> None:
    """Call run(begin, end, interrupted) for parts of range(count), one on each thread if they fill the lanes.

    An exception in this thread, as of Ctrl-C, sets `interrupted` (1,), and the loops end. This thread only
    waits, since Python handles signals between two of its instructions.
    """
    interrupted = np.zeros(1, np.int64)
    if count <= LANES:  # too short to wait for another thread
        run(0, count, interrupted)
        return
    threads = min(get_num_threads(), math.ceil(count / LANES))
    cuts = [count * part // threads for part in range(threads + 1)]
    calls: list[Future] = []
    run(0, 0, interrupted)  # compiles it, here where a signal is handled
    try:
        for begin, end in pairwise(cuts):
            calls.append(_pool(threads).submit(run, begin, end, interrupted))
        for call in calls:
            call.result()
    finally:
        interrupted[0] = 1
        wait(calls)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: starting them takes as long as a short search's generation."""
    return ThreadPoolExecutor(threads, "simbias")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
