"""Evaluating a sequential search's points together.

The points that DIRECT asks for next rarely depend on the last few costs. So a search is run on with guessed
costs until it has asked for some points; they are evaluated together, and the search is run again from its
start on what is known. The last run knows every cost: it is the sequential search, point by point.
"""

from __future__ import annotations

import numpy as np

from simbias.records import Array
from simbias.search import Evaluations, Search, SearchEnded

FIRST_GUESS = 1e6
MOST = 32  # points evaluated together; of more, too many guesses are wrong


class AskedEnough(Exception):  # noqa: N818 (no error, as StopIteration is none)
    """Ends a run on guesses."""


def look_ahead(search: Search, evaluations: Evaluations) -> str:
    """Run a search on evaluations; why it ended, in words.

    `search` has to ask for the same points when it is given the same costs. An objective that offers
    `together` is asked for several at once; one that does not, in turn.
    """
    together = evaluations.together
    if together is None:
        return search(evaluations)
    known: dict[bytes, float] = {}
    guessed: dict[bytes, Array] = {}
    size = MOST
    while True:
        rehearsal = Rehearsal(known, size, evaluations.spent if known else None)
        if (stopped_by := rehearsal.run(search, evaluations)) is not None:
            return stopped_by
        used = sum(point in rehearsal.asked for point in guessed)
        if guessed:
            if not used:
                raise RuntimeError("the search asks for other points when it is given the same costs")
            size = min(2 * used, MOST)  # where most guesses were wrong, fewer are made
        guessed = rehearsal.unknown
        known.update(zip(guessed, together(np.array(list(guessed.values()))), strict=True))


class Rehearsal:
    """A run of a search on known costs, guesses in place of others, until it asked for `size` of those.

    Where the search's steps or seconds are spent, it ends with what is known.
    """

    def __init__(self, known: dict[bytes, float], size: int, spent: str | None) -> None:
        self._known = known
        self._size = size
        self._spent = spent
        self._guess = max(known.values(), default=FIRST_GUESS)
        self.asked: set[bytes] = set()
        self.unknown: dict[bytes, Array] = {}

    def run(self, search: Search, evaluations: Evaluations) -> str | None:
        """Why the search ended, in words; None if it asked for unknown costs, and is to be run again."""
        rehearsed = evaluations.rehearsal(self._recall)
        try:
            stopped_by = rehearsed.run(search)
        except AskedEnough:
            return None
        if self.unknown:
            return None
        evaluations.adopt(rehearsed)
        return stopped_by

    def _recall(self, point: Array) -> float:
        """The cost of a point (p,), known or guessed."""
        key = point.tobytes()
        self.asked.add(key)
        if key not in self._known:
            if self._spent is not None:
                raise SearchEnded(self._spent)
            self.unknown[key] = point.copy()
            if len(self.unknown) >= self._size:
                raise AskedEnough
        return self._known.get(key, self._guess)
