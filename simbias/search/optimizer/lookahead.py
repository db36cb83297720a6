"""Evaluating a sequential search's points together.

The points that DIRECT asks for next rarely depend on the last few costs. So a search is run on with guessed
costs until it has asked for some points; they are evaluated together, all of them or some, and the search is
run again from its start on what is known. The last run knows every cost: it is the sequential search, point
by point. Costs that a run was told before its first guess are told to every later run, too, so they are not
looked up again.
"""

from __future__ import annotations

from copy import copy
from itertools import compress

import numpy as np

from simbias.core.evaluations import Evaluations, Search, SearchEnded
from simbias.core.records import Array, Flags

FIRST_GUESS = 1e6
MOST = 32  # points asked for together; of more, too many guesses are wrong
CAPRICIOUS = "the search asks for other points when it is given the same costs"


class AskedEnough(Exception):  # noqa: N818 (no error, as StopIteration is none)
    """Ends a run on guesses."""


def look_ahead(search: Search, evaluations: Evaluations) -> str:
    """Run a search on evaluations; why it ended, in words.

    `search` has to ask for the same points when it is given the same costs. An objective that offers
    `together` or `speculate` is asked for several at once; one that does not, in turn.
    """
    if evaluations.together is None:
        return search(evaluations)
    past = Past(evaluations)
    asked: list[bytes] = []  # by the last run, of what was not known
    guessed: list[bytes] = []  # those of them that have been evaluated
    size = MOST
    while True:
        rehearsal = Rehearsal(past, size, evaluations.spent if past.known else None)
        if (stopped_by := rehearsal.run(search, evaluations)) is not None:
            return stopped_by
        if not rehearsal.asked.issuperset(asked[:1]):
            raise RuntimeError(CAPRICIOUS)
        if guessed:
            used = sum(point in rehearsal.asked for point in guessed)
            size = min(max(2 * used * size // len(guessed), 1), MOST)  # where most were wrong, fewer are made
        asked = list(rehearsal.unknown)
        costs, known = _evaluated(evaluations, np.array(list(rehearsal.unknown.values())))
        guessed = list(compress(asked, known))
        past.known.update(zip(guessed, costs[known].tolist(), strict=True))


def _evaluated(evaluations: Evaluations, points: Array) -> tuple[Array, Flags]:
    """Costs (k,) of points (k, p), and whether they are known (k,): one at least is, all by `together`."""
    if evaluations.speculate is not None:
        return evaluations.speculate(points)
    assert evaluations.together is not None
    return evaluations.together(points), np.full(len(points), True)


class Past:
    """What is known of a search: costs by point, and those of its first points, in their order."""

    def __init__(self, evaluations: Evaluations) -> None:
        self.known: dict[bytes, float] = {}
        self.first: list[float] = []
        self.end = evaluations  # as they stand after the first
        self.next: bytes | None = None  # the point that follows them


class Rehearsal:
    """A run of a search on known costs, guesses in place of others, until it asked for `size` of those.

    Where the search's steps or seconds are spent, it ends with what is known.
    """

    def __init__(self, past: Past, size: int, spent: str | None) -> None:
        self._past = past
        self._size = size
        self._spent = spent
        self._guess = max(past.known.values(), default=FIRST_GUESS)
        self.asked: set[bytes] = set()
        self.unknown: dict[bytes, Array] = {}

    def run(self, search: Search, evaluations: Evaluations) -> str | None:
        """Why the search ended, in words; None if it asked for unknown costs, and is to be run again."""
        self._evaluations = evaluations.rehearsal(self._recall, self._past.first, self._past.end)
        try:
            stopped_by = self._evaluations.run(search)
        except AskedEnough:
            return None
        if self.unknown:
            return None
        evaluations.adopt(self._evaluations)
        return stopped_by

    def _recall(self, point: Array) -> float:
        """The cost of a point (p,), known or guessed."""
        key = point.tobytes()
        if not self.asked and self._past.next not in (None, key):
            raise RuntimeError(CAPRICIOUS)
        self.asked.add(key)
        cost = self._past.known.get(key)
        if cost is None:
            if self._spent is not None:
                raise SearchEnded(self._spent)
            if not self.unknown:
                self._past.end, self._past.next = copy(self._evaluations), key
            self.unknown[key] = point.copy()
            if len(self.unknown) >= self._size:
                raise AskedEnough
            return self._guess
        if not self.unknown:
            self._past.first.append(cost)
        return cost
