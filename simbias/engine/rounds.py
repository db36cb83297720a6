"""Running tasks on workers that may die, round after round, until each has its result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from simbias.interfaces import R, T, WorkerLostError

MOST_LOSSES = 3  # of a task's worker, until the task is to blame

Round = Callable[[Iterable[tuple[int, Any]], bool], Iterator[tuple[int, Any]]]


class RoundBrokenError(RuntimeError):
    """Workers died; what they ran is not done."""


def until_done(run_round: Round, tasks: Sequence[T]) -> Iterator[tuple[int, R | WorkerLostError]]:
    """Yield (index, result) of every task once, whatever becomes of workers.

    `run_round(calls, alone)` yields the results of (index, task) calls and raises RoundBrokenError when
    workers died; it takes a call only when it is about to run it, if `alone` only when none else runs.
    A task that was under way in two broken rounds runs alone from then on, so that no other is blamed.
    """
    missing = dict(enumerate(tasks))
    losses: Counter[int] = Counter()
    while missing:
        suspects = [index for index in missing if losses[index] >= MOST_LOSSES - 1]
        alone = len(suspects) == len(missing)
        chosen = suspects[:1] if alone else [index for index in missing if index not in suspects]
        taken: list[int] = []
        calls = ((index, _noted(taken, index, missing[index])) for index in chosen)
        try:
            for index, result in run_round(calls, alone):
                if index in missing:  # not a late result of a round that was given up
                    del missing[index]
                    yield index, result
        except RoundBrokenError as error:
            for index in taken:
                losses[index] += index in missing
            for index in [index for index in missing if losses[index] >= MOST_LOSSES]:
                del missing[index]
                yield index, WorkerLostError(f"its worker died {MOST_LOSSES} times: {error}")


def _noted(taken: list[int], index: int, task: T) -> T:
    """The task, noted as taken."""
    taken.append(index)
    return task


def call(function: Callable[[T], R], index: int, task: T) -> tuple[int, R]:
    """A task's result, with its index: what a worker does."""
    return index, function(task)
