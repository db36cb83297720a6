"""Checks whether recorded rates agree with the changes of their positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from simbias.core import HardwareError, Task, rate_pairs
from simbias.core.records import Array, Indices, Rollout
from simbias.learning.noise import noise_of

SLOWEST = 0.05  # s, interval over which positions and velocities are compared
LATEST, CLEARLY = 0.1, 0.5  # s, largest delay of a rate; largest share of squared differences left then
LATE, PART = 0.0015, 0.15  # s, share of a frame: tolerated delays, as of simulators with few steps
SURE = 4.0  # standard errors of a significant delay
TWICE = 2.0  # allowed ratio of position changes to integrated velocities
CORRELATED = 0.8  # correlation below which sizes of velocities are not compared
UNRELATED, CLEAR = 0.3, 4.0  # correlation below which, at any delay, columns are unrelated; change over noise
LASTING = 0.5  # s, least duration of changes for a verdict
JUMP = 3.0  # times the largest velocity's motion between two samples: impossible for a robot
AROUND = 4  # samples to each side, for a rate without a column
RARELY, FAR = 0.98, 4.0  # a jump exceeds this quantile of samples by this factor


def rates_of(task: Task) -> dict[int, int]:
    """A map from each state that is a rate to its position, by their indices."""
    return {rate: position for position, rate in rate_pairs(task.without_targets.states)}


def check_rates(source: str, pieces: Sequence[Rollout], task: Task, rates: Mapping[int, int]) -> None:
    """Refuse rates that disagree with their positions: degrees, a time in ms, a wrong column.

    `rates` maps indices of rates to indices of their positions.
    """
    names, noise = [state.name for state in task.states], noise_of(pieces)
    for i, position in rates.items():
        changes = _changes(pieces, i, position, task)
        moved, told = _delayed(changes, 0, 0)
        lasting = len(moved) >= LASTING / task.time_step
        if lasting and not moved.any() and _is_clear((told - told.mean()) / SLOWEST, noise[i]):
            raise HardwareError(
                f"{source}: {names[position]} never changes, but {names[i]} does: is it stuck?"
            )
        if abs(_agreement(moved, told)) >= CORRELATED:
            ratio = float(told @ moved) / float(told @ told)
            if not 1 / TWICE < ratio < TWICE:
                raise HardwareError(
                    f"{source}: {names[position]} changes {ratio:.3g} times as fast as {names[i]} implies: "
                    "is a unit or a column wrong?"
                )
        elif lasting and _is_clear(moved, noise[position]) and _is_clear(told / SLOWEST, noise[i]):
            lags = range(task.frames(LATEST) + 1)
            if max(_agreement(*_delayed(changes, late, late)) for late in lags) < UNRELATED:
                raise HardwareError(
                    f"{source}: {names[position]} does not change as {names[i]} implies: "
                    "is a column or a unit wrong?"
                )


def jumps(times: Array, values: Array, rates: Array) -> Indices:
    """Samples (j,) before which values (k,) jump, by much more than their rates (k,) explain."""
    steps, moved = np.diff(times), np.diff(values)
    excess = np.abs(moved - steps * (rates[1:] + rates[:-1]) / 2)
    usual = np.quantile(excess[moved != 0], RARELY) if moved.any() else np.inf  # e.g. an encoder's step
    due = np.maximum(steps, np.median(steps))  # a sample may be late, and the next one on time
    return np.flatnonzero(excess > np.maximum(JUMP * np.abs(rates).max() * due, FAR * usual)) + 1


def usual_rates(times: Array, values: Array) -> Array:
    """Rates (k,) of values (k,): the median slope around each sample, which a jump does not change."""
    each = np.pad(np.diff(values) / np.diff(times), AROUND, "edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(each, 2 * AROUND), axis=1))


def lone_jumps(times: Array, values: Array) -> Indices:
    """Samples (j,) before which values (k,) without rates jump; a motion lasts for two intervals at least."""
    slopes = np.diff(values) / np.diff(times)
    padded = np.pad(slopes, 1, "edge")
    along = np.maximum(padded[:-2] * np.sign(slopes), padded[2:] * np.sign(slopes))
    found = jumps(times, values, usual_rates(times, values))
    return found[np.abs(slopes[found - 1]) > JUMP * along[found - 1]]


def late_rates(pieces: Sequence[Rollout], task: Task, rates: Mapping[int, int]) -> dict[int, float]:
    """Delays in s of recorded rates behind the changes of their positions, by index, where significant."""
    latest, found = task.frames(LATEST), {}
    for i, position in rates.items():
        changes = _changes(pieces, i, position, task)
        delayed = (_delayed(changes, late, latest) for late in range(latest + 1))
        errors = [float(np.sum((told - moved) ** 2)) for moved, told in delayed]
        late = int(np.argmin(errors))
        if errors[late] < CLEARLY * errors[0]:
            found[i] = late * task.time_step
        elif (delay := _delay(pieces, i, changes, task)) >= max(LATE, PART * task.time_step):
            found[i] = delay
    return found


def _delay(pieces: Sequence[Rollout], rate: int, changes: Sequence[tuple[Array, Array]], task: Task) -> float:
    """The delay of a rate in s, possibly a fraction of a frame; 0 unless significant.

    To first order, the integrated rate differs from a change by the delay times the rise of the rate in the
    interval.
    """
    moved, told = _delayed(changes, 0, 0)
    k, lacking = task.frames(SLOWEST), moved - told
    rises = np.concatenate([x.states[k:, rate] - x.states[:-k, rate] for x in pieces])
    if len(lacking) < LASTING / task.time_step or not (size := float(rises @ rises)):
        return 0.0
    delay = float(lacking @ rises) / size
    left = lacking - delay * rises  # residuals of overlapping intervals
    return delay if delay > SURE * np.sqrt(2 * k * np.mean(left**2) / size) else 0.0


def _changes(pieces: Sequence[Rollout], rate: int, position: int, task: Task) -> list[tuple[Array, Array]]:
    """For each piece, changes (m,) of a state over intervals, and the rate's integrals, by trapezoids."""
    k, changes = task.frames(SLOWEST), []
    for x, v in ((piece.states[:, position], piece.states[:, rate]) for piece in pieces):
        total = task.time_step * (np.cumsum(v) - v / 2)
        changes.append((x[k:] - x[:-k], total[k:] - total[:-k]))
    return changes


def _delayed(changes: Sequence[tuple[Array, Array]], late: int, latest: int) -> tuple[Array, Array]:
    """All changes, and integrated rates some frames later, truncated to the number at the latest delay."""
    counts = [max(len(moved) - latest, 0) for moved, _ in changes]
    moved = [each[:count] for (each, _), count in zip(changes, counts, strict=True)]
    told = [each[late : late + count] for (_, each), count in zip(changes, counts, strict=True)]
    return np.concatenate(moved), np.concatenate(told)


def _agreement(moved: Array, told: Array) -> float:
    """The uncentred correlation of two series (m,); 0 if one is zero."""
    size = float(told @ told) * float(moved @ moved)
    return float(told @ moved) / np.sqrt(size) if size > 0 else 0.0


def _is_clear(changes: Array, noise: float) -> bool:
    """Whether changes (m,) are many times larger than noise of this deviation would cause."""
    return float(np.sqrt(np.mean(changes**2))) > CLEAR * noise
