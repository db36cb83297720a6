"""Rollouts of policies that come a few at a time, as a sequential search asks, in lanes that stay filled.

A call ends when some rollouts have. Those under way go on in the next call if their policies are still asked
for; else others take their lanes. So lanes idle at the end of a search alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numba import get_num_threads

from simbias.core import Cost
from simbias.core.records import Array, Indices
from simbias.simulation.compiled import CompiledSimulator, Made
from simbias.simulation.compiler.fused import INTEGERS
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.threads import at_once

NEEDED = 3 * LANES // 4  # rollouts that end on each thread before a search hears of them
THREADS = 2  # at most: more would have to guess farther ahead


class Stream:
    """Rollouts from one start (n,), in one world."""

    def __init__(self, simulator: CompiledSimulator, cost: Cost, start: Array) -> None:
        self._simulator, self._cost, self._start = simulator, cost, start
        self._threads: list[_Lanes] = []

    def costs(self, thetas: Array) -> tuple[Array, Indices]:
        """Costs and frames (k,) of thetas (k, p), begun in this order; -1 frames of those not ended."""
        k, simulator, cost = len(thetas), self._simulator, self._cost
        loop, rows = simulator.loop(cost)
        self._threads = self._threads or [_Lanes(rows) for _ in range(min(get_num_threads(), THREADS))]
        keys = [theta.tobytes() for theta in thetas]
        under_way = [lanes.keep(keys) for lanes in self._threads]
        others = sorted(set(range(k)).difference(*under_way))
        policies = simulator.policy.parameters(np.asarray(thetas, dtype=np.float64))
        worlds = np.zeros(k, np.int64)
        starts, made = np.tile(self._start, (k, 1)), Made.of(k, cost, simulator.task)

        def run(thread: int) -> None:
            lanes, begun = self._threads[thread], under_way[thread]
            mine = [*begun, *others[thread :: len(self._threads)]]
            count, own = len(mine), made.part(mine)
            needed = min(NEEDED, count)
            loop(policies[mine], worlds[:count], starts[:count], *own.arrays, needed, len(begun), lanes.rows)
            made.put(mine, own)
            lanes.note([keys[number] for number in mine])

        at_once([partial(run, thread) for thread in range(len(self._threads))])
        return made.costs(cost, simulator.task.horizon), made.frames


class _Lanes:
    """The lanes of a thread between two calls of the loop, and whose rollouts are under way in them."""

    def __init__(self, rows: int) -> None:
        self.rows = np.zeros((rows, LANES))
        integers = dict(zip(INTEGERS, self.rows[-len(INTEGERS) :].view(np.int64), strict=True))
        self._running, self._rollout = integers["running"], integers["rollout"]
        self._keys: dict[int, bytes] = {}  # of policies, by lane

    def keep(self, keys: Sequence[bytes]) -> list[int]:
        """Give up all rollouts but those of these policies; which of these are under way."""
        numbers = {key: number for number, key in enumerate(keys)}
        self._keys = {lane: key for lane, key in self._keys.items() if key in numbers}
        self._running[:] = 0
        for position, lane in enumerate(self._keys):
            self._running[lane], self._rollout[lane] = 1, position
        return [numbers[key] for key in self._keys.values()]

    def note(self, keys: Sequence[bytes]) -> None:
        """Note which of these policies the loop has left under way."""
        self._keys = {lane: keys[self._rollout[lane]] for lane in np.flatnonzero(self._running).tolist()}
