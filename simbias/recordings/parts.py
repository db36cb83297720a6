"""Recordings, and their parts that are held out in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from simbias.core.records import Rollout

MOST_PARTS = 5
PIECES = 3  # of a single recording


class Part(NamedTuple):
    """Recordings that are held out together."""

    name: str
    rollouts: tuple[Rollout, ...]  # their pieces
    recordings: tuple[str, ...] = ()  # recording of each rollout; by default each is its own

    @staticmethod
    def of(name: str, recordings: Mapping[str, Sequence[Rollout]]) -> Part:
        """A part of whole recordings."""
        pieces = [(each, rollout) for each, rollouts in recordings.items() for rollout in rollouts]
        return Part(name, tuple(rollout for _, rollout in pieces), tuple(each for each, _ in pieces))


def parts(recordings: Mapping[str, Sequence[Rollout]]) -> list[Part]:
    """Each recording, or the thirds of a single one; more than five are distributed among five parts."""
    if len(recordings) == 1:
        ((name, pieces),) = recordings.items()
        frames = sum(piece.frames for piece in pieces)
        cuts = pairwise(frames * i // PIECES for i in range(PIECES + 1))
        return [
            Part.of(f"{name}, part {i}", {name: list(_between(pieces, *cut))})
            for i, cut in enumerate(cuts, start=1)
        ]
    names = list(recordings)
    dealt = [names[i::MOST_PARTS] for i in range(min(MOST_PARTS, len(names)))]
    return [Part.of(" + ".join(each), {name: recordings[name] for name in each}) for each in dealt]


def _between(pieces: Sequence[Rollout], begin: int, end: int) -> Iterator[Rollout]:
    """The frames from `begin` up to `end` of the concatenated pieces."""
    for piece in pieces:
        first, last = max(begin, 0), min(end, piece.frames)
        if first < last:
            yield piece.part(first, last)
        begin, end = begin - piece.frames, end - piece.frames


def others(all_parts: Sequence[Part], index: int) -> Part:
    """All parts except one, merged."""
    rest = [part for i, part in enumerate(all_parts) if i != index]
    return Part(
        f"all but {all_parts[index].name}",
        tuple(rollout for part in rest for rollout in part.rollouts),
        tuple(name for part in rest for name in part.recordings),
    )
