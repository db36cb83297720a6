"""Recordings, and their parts that are held out in turn."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from simbias.core.records import Rollout

MOST_PARTS = 5
PIECES = 3  # of a single recording


class Part(NamedTuple):
    """Recordings that are held out together."""

    name: str
    pieces: Mapping[str, Sequence[Rollout]]  # of each recording, by its name

    @property
    def rollouts(self) -> list[Rollout]:
        """All pieces."""
        return [rollout for pieces in self.pieces.values() for rollout in pieces]

    @property
    def recordings(self) -> list[str]:
        """The recording of each of the `rollouts`."""
        return [name for name, pieces in self.pieces.items() for _ in pieces]


def parts(recordings: Mapping[str, Sequence[Rollout]]) -> list[Part]:
    """Each recording, or the thirds of a single one; more than five are distributed among five parts."""
    if len(recordings) == 1:
        ((name, pieces),) = recordings.items()
        frames = sum(piece.frames for piece in pieces)
        cuts = pairwise(frames * i // PIECES for i in range(PIECES + 1))
        return [
            Part(f"{name}, part {i}", {name: list(_between(pieces, *cut))})
            for i, cut in enumerate(cuts, start=1)
        ]
    names = list(recordings)
    dealt = [names[i::MOST_PARTS] for i in range(min(MOST_PARTS, len(names)))]
    return [Part(" + ".join(each), {name: recordings[name] for name in each}) for each in dealt]


def _between(pieces: Sequence[Rollout], begin: int, end: int) -> Iterator[Rollout]:
    """The frames from `begin` up to `end` of the concatenated pieces."""
    for piece in pieces:
        first, last = max(begin, 0), min(end, piece.frames)
        if first < last:
            yield piece.part(first, last)
        begin, end = begin - piece.frames, end - piece.frames


def others(all_parts: Sequence[Part], index: int) -> Part:
    """All parts except one, merged."""
    merged = defaultdict[str, list[Rollout]](list)
    for part in (*all_parts[:index], *all_parts[index + 1 :]):
        for name, pieces in part.pieces.items():
            merged[name] += pieces
    return Part(f"all but {all_parts[index].name}", merged)
