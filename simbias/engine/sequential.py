"""The engine without workers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from simbias.engine.contract import Engine, R, Results, T


class Sequential(Engine):
    """One task after the other, in this process: for robots, debugging and comparison."""

    has_workers = False

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Results[R]:
        """Yield each task's index and result, in order."""
        for index, task in enumerate(tasks):
            yield index, function(task)
