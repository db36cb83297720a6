"""No workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from simbias.engine.contract import Engine, R, T, WorkerLostError


class Sequential(Engine):
    """One task after the other, in this process: to debug, and to compare with."""

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Yield each task's index and result, in order."""
        for index, task in enumerate(tasks):
            yield index, function(task)
