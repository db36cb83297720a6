"""Recordings, and the parts of them that are held out in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from simbias.core.records import Rollout

MOST_PARTS = 5
PIECES = 3  # of a single recording


class Part(NamedTuple):
    """Recordings that are held out together."""

    name: str
    rollouts: tuple[Rollout, ...]


def parts(recordings: Mapping[str, Rollout]) -> list[Part]:
    """Each recording, or the thirds of a single one; more than five are dealt into five parts."""
    if len(recordings) == 1:
        ((name, whole),) = recordings.items()
        cuts = [whole.frames * i // PIECES for i in range(PIECES + 1)]
        return [Part(f"{name}, part {i + 1}", (whole.part(*cut),)) for i, cut in enumerate(pairwise(cuts))]
    names = list(recordings)
    dealt = [names[i::MOST_PARTS] for i in range(min(MOST_PARTS, len(names)))]
    return [Part(" + ".join(each), tuple(recordings[name] for name in each)) for each in dealt]


def others(all_parts: Sequence[Part], index: int) -> list[Rollout]:
    """The rollouts of all parts but one."""
    return [rollout for i, part in enumerate(all_parts) if i != index for rollout in part.rollouts]
