"""Compiled loops on all threads."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise

from numba import get_num_threads

from simbias.simulation.compiler.kernels import LANES


def in_threads(run: Callable[[int, int], object], count: int) -> None:
    """Call run(begin, end) for parts of range(count), one on each thread, if they fill the lanes."""
    threads = max(1, min(get_num_threads(), math.ceil(count / LANES)))
    cuts = [count * part // threads for part in range(threads + 1)]
    at_once([partial(run, begin, end) for begin, end in pairwise(cuts)])


def at_once(calls: Sequence[Callable[[], object]]) -> None:
    """Make these calls, one on each thread."""
    if len(calls) == 1:
        calls[0]()
    else:
        list(_pool(len(calls)).map(lambda call: call(), calls))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: starting them takes as long as a short search's generation."""
    return ThreadPoolExecutor(threads, "simbias")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork
