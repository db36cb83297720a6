"""Copies among recordings: parts that are the same but for their clock, a few digits, or where they are cut.

A digest of a block holds signs of random projections (SimHash: M. Charikar, STOC 2002), which are mostly the
same for similar blocks: of the states, and of differences over several samples. The latter are mainly
measurement noise, in which copies agree and repeated experiments do not. Where they are motion, as without
noise or at low rates, a hash of the samples replaces them, so that only exact copies are found.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import lru_cache
from hashlib import blake2b
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from simbias.core.records import Array, Flags, Rollout

BLOCK = 1.0  # s; half, a quarter, ... in shorter pieces
FEWEST = 50  # frames of a block
ORDER = 5  # of the differences
BITS = 64  # projections of each kind
DIFFERENT = 8  # signs of each kind that may differ between copies; between others, it is 32 +- 4
SIZES = 0.05  # by which the sizes of copies may differ, relative to them
EVENTS = 20.0  # effective number of differences: with fewer, blocks at rest are similar
STILL = 1e-6  # of a state's largest value: smaller deviations are none

Bits = NDArray[np.uint64]


class Digest(NamedTuple):
    """The digest of a block: bits, and sizes, which are geometric means over states; no noise has size 0."""

    frames: int
    noise: int
    motion: int
    noise_size: float
    motion_size: float

    def __str__(self) -> str:
        sizes = f"{self.noise_size:.3g} {self.motion_size:.3g}"
        return f"{self.frames} {self.noise:016x} {self.motion:016x} {sizes}"

    @staticmethod
    def of(text: str) -> Digest:
        """The digest in a text, as `str` writes it; a ValueError if it is none."""
        frames, noise, motion, *sizes = text.split()
        noise_size, motion_size = map(float, sizes)
        return Digest(int(frames), int(noise, 16), int(motion, 16), noise_size, motion_size)


def digests(pieces: Sequence[Rollout], time_step: float) -> list[Digest]:
    """Digests of blocks that cover pieces of a recording, without blocks in which little happens."""
    found = []
    for piece in pieces:
        if frames := _block(piece.frames, time_step):
            blocks = Blocks(piece.states, frames)
            starts = {*range(0, len(blocks.tell), frames), len(blocks.tell) - 1}
            found += [blocks.digest(i) for i in sorted(starts) if blocks.tell[i]]
    return found


def copied(piece: Rollout, known: Collection[Digest]) -> Flags:
    """Frames (k,) of a piece that are copies of blocks with known digests."""
    found = np.zeros(piece.frames, bool)
    for frames in {each.frames for each in known if each.frames <= piece.frames}:
        blocks = Blocks(piece.states, frames)
        same = np.zeros(len(blocks.tell), bool)
        for each in known:
            if each.frames == frames:
                same |= blocks.same(each)
        for start in np.flatnonzero(same).tolist():
            found[start : start + frames] = True
    return found


def new(piece: Rollout, known: Collection[Digest], time_step: float) -> list[tuple[int, int]]:
    """Begin and end of the parts of a piece that are no copies, without short parts beside copies."""
    copies = copied(piece, known)
    if not copies.any():
        return [(0, piece.frames)]
    edges = np.flatnonzero(np.diff(~copies, prepend=False, append=False)).tolist()
    shortest = _block(piece.frames, time_step)
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > shortest]


def _block(frames: int, time_step: float) -> int:
    """The number of frames of a block in a piece with this many; 0 if the piece is too short."""
    block = max(round(BLOCK / time_step), FEWEST)
    while block > frames:
        block //= 2
    return block if block >= FEWEST else 0


class Blocks:
    """The digests of the blocks of this many frames that begin in each frame (k,) of some states."""

    def __init__(self, states: Array, frames: int) -> None:
        self._frames, differences = frames, np.diff(states, ORDER, axis=0)
        self._noise, self._noises, events = _projected(differences, frames + 1 - ORDER)
        smooth = _smooth(differences, frames + 1 - ORDER)
        self._noises[smooth] = 0.0
        for i in np.flatnonzero(smooth):
            samples = blake2b(states[i : i + frames + 1].tobytes(), digest_size=8)
            self._noise[i] = int(samples.hexdigest(), 16)
        self._motion, self._motions, _ = _projected(states[:-1] - states.mean(axis=0), frames)
        # At rest there are few events, such as an encoder's counts.
        self.tell = (self._motions > 0) & ((events > EVENTS) | (self._motions > self._noises))

    def digest(self, i: int) -> Digest:
        """The digest of the block that begins in frame i."""
        bits = int(self._noise[i]), int(self._motion[i])
        return Digest(self._frames, *bits, float(self._noises[i]), float(self._motions[i]))

    def same(self, other: Digest) -> Flags:
        """Which blocks (k,) are copies of another."""
        same = self.tell & _near(self._noises, other.noise_size) & _near(self._motions, other.motion_size)
        for bits, others in (self._noise, other.noise), (self._motion, other.motion):
            same &= np.bitwise_count(bits ^ np.uint64(others)) <= DIFFERENT
        return same


def _near(sizes: Array, size: float) -> Flags:
    return np.abs(sizes - size) <= SIZES * size


def _smooth(differences: Array, length: int) -> Flags:
    """In which blocks (k,) differences are motion: those of noise have changing signs."""
    scaled = differences / np.maximum(np.abs(differences).max(axis=0), np.finfo(float).tiny)
    n = scaled.shape[1]
    products = _moving(scaled[1:] * scaled[:-1], np.ones((length - 1, n)))
    squares = _moving(scaled**2, np.ones((length, n)))
    return np.asarray((products / np.maximum(squares, STILL**2)).sum(axis=1) > 0)


def _projected(values: Array, length: int) -> tuple[Bits, Array, Array]:
    """Signs of projections, sizes, and effective numbers of events (k,), of all blocks of values."""
    n = values.shape[1]
    largest = np.maximum(np.abs(values).max(axis=0), np.finfo(float).tiny)
    scaled = values / largest
    mean, square, fourth = (_moving(scaled**p, np.full((length, n), 1 / length)) for p in (1, 2, 4))
    deviation = np.sqrt(np.maximum(square - mean**2, 0.0))
    moves = deviation > STILL
    inverse = np.where(moves, 1 / np.maximum(deviation, STILL), 0.0)
    count = np.maximum(moves.sum(axis=1), 1)
    events = length * count**2 / np.maximum((fourth * inverse**4).sum(axis=1), 1.0)
    logs = np.where(moves, np.log(largest * np.maximum(deviation, STILL)), 0.0)
    sizes = np.exp(logs.sum(axis=1) / count) * moves.any(axis=1)
    weights = _weights(length, n)
    projected = sum(inverse[:, [i]] * _moving(scaled[:, [i]], weights[i]) for i in range(n))
    return (
        np.packbits(projected > 0, axis=1).view(">u8")[:, 0].astype(np.uint64),
        sizes,
        events,
    )


def _moving(values: Array, weights: Array) -> Array:
    """Sums (k, m) of values (k + l - 1, m or 1), with weights (l, m), over l rows from each row on."""
    return np.asarray(oaconvolve(values, weights[::-1], mode="valid", axes=0))


@lru_cache(maxsize=8)
def _weights(length: int, n: int) -> Array:
    """Random weights (n, length, BITS) whose sum over a block is 0; the same everywhere."""
    weights = np.random.default_rng(0).standard_normal((n, length, BITS))
    return weights - weights.mean(axis=1, keepdims=True)
