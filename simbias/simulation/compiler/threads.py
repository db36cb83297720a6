"""Compiled loops on all threads."""

from __future__ import annotations

import math
import os
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numba import get_num_threads

from simbias.simulation.compiler.kernels import LANES

SHORT = 8 * LANES  # passes that take one thread at most 2 s: 5000 frames with an exact Gaussian process


def in_threads(run: partial, count: int) -> None:
    """Call a compiled loop, run(begin, end, interrupted), for parts of range(count), on all threads.

    An exception in this thread, such as from Ctrl-C, sets `interrupted` (1,), and the loops end. This thread
    only waits, since Python handles signals between its instructions; the handover takes some 60 us.
    """
    interrupted = np.zeros(1, np.int64)
    threads = max(1, min(get_num_threads(), math.ceil(count / LANES)))  # threads with filled lanes
    if threads == 1 and count <= SHORT:
        run(0, count, interrupted)
        return
    cuts = [count * part // threads for part in range(threads + 1)]
    calls: list[Future] = []
    loop: Any = run.func
    if not loop.signatures:  # compile here, where a signal is handled
        run(0, 0, interrupted)
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
    """Persistent threads: starting them takes as long as a generation of a short search."""
    return ThreadPoolExecutor(threads, "simbias")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
