"""Evaluate a sequential search's points in lockstep.

The points that DIRECT requests next rarely depend on the last few costs. A search therefore continues on
guessed costs until it has requested several points. These are evaluated together, and the search is rerun
from its start on the known costs. Costs before the first guess are true, and judged in order. The last run,
which guesses none, is thus the sequential search, point by point.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field

import numpy as np

from simbias.core.evaluations import Evaluations, SearchEnded
from simbias.core.records import Array

FIRST_GUESS = 1e6
MOST = 32  # points requested together; with more, too many guesses are wrong
CAPRICIOUS = "the search asks for other points when it is given the same costs"


class AskedEnough(Exception):  # noqa: N818 (no error, as StopIteration is none)
    """Ends a run on guesses once it has requested enough points."""


def look_ahead(search: Callable[[Callable[[Array], float]], str], evaluations: Evaluations) -> str:
    """Run a search, which gets a function that evaluates a point (p,); why it ended, in words.

    The search has to request the same points when given the same costs. An objective that supports `together`
    evaluates several points at once; otherwise they are evaluated one by one.
    """
    together = evaluations.together
    if together is None:
        return search(evaluations.evaluate)
    past = Past()
    guessed: dict[bytes, Array] = {}  # points guessed in the last run, whose costs are known since
    size = MOST
    while True:
        run = Run(evaluations, past, size)
        try:
            stopped_by = search(run.evaluate)
        except (AskedEnough, SearchEnded):
            if not run.unknown:
                raise
        if not run.unknown:
            return stopped_by
        if guessed:
            used = sum(point in run.asked for point in guessed)
            size = min(max(2 * used * size // len(guessed), 1), MOST)  # fewer guesses if most were wrong
        guessed = run.unknown
        costs = together(np.array(list(guessed.values())))
        past.known.update(zip(guessed, costs.tolist(), strict=True))


@dataclass
class Past:
    """Costs and points known from earlier runs of a search."""

    judged: list[float] = field(default_factory=list)  # costs of the first points that the search requests
    next: bytes | None = None  # the next point
    known: dict[bytes, float] = field(default_factory=dict)  # costs by point


class Run:
    """A run of a search on known costs, with up to `size` guesses for unknown ones."""

    def __init__(self, evaluations: Evaluations, past: Past, size: int) -> None:
        self._evaluations = evaluations
        self._past = past
        self._replayed = iter(past.judged[:])
        self._guess = max(past.known.values(), default=FIRST_GUESS)
        self._size = size
        self.asked: set[bytes] = set()  # points requested after the replayed ones
        self.unknown: dict[bytes, Array] = {}

    def evaluate(self, point: Array) -> float:
        """The cost of a point (p,), or a guess; AskedEnough if `size` costs are unknown.

        SearchEnded as from `Evaluations.evaluate`; if some costs are unknown, assuming correct guesses.
        """
        if (judged := next(self._replayed, None)) is not None:
            return judged
        inside = self._evaluations.inside(point)
        key = inside.tobytes()
        if not self.asked and self._past.next not in (None, key):
            raise RuntimeError(CAPRICIOUS)
        self.asked.add(key)
        if not self.unknown:
            self._past.next = key
        cost = self._past.known.get(key)
        if cost is None:
            cost = self._guessed(inside, key)
        elif not self.unknown:
            self._past.judged.append(cost)
        return self._evaluations.judge(inside, cost)

    def _guessed(self, inside: Array, key: bytes) -> float:
        """A guess for an unknown cost."""
        self._evaluations.check_budget()
        if not self.unknown:
            self._evaluations = copy(self._evaluations)  # guesses, and later points, are judged separately
        self.unknown[key] = inside
        if len(self.unknown) == self._size:
            raise AskedEnough
        return self._guess
