"""White noise in recorded states: its size, and smoothing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np

from simbias.core.records import Array, Rollout

LINEAR = 1e-9  # of a state's range: smaller second differences are rounding
FEWEST = 8  # samples needed to find a state's sampling interval
DEGREE = 4  # of polynomials, which preserve the amplitude of oscillations
FEWEST_AROUND = 3  # frames to each side of a smoothed one
WIDTHS = 12  # candidate numbers of frames
OUTLIER = 4.0  # deviations of noise
EVEN = 2.0  # ratio of long to short sampling intervals; an encoder's steps differ more
MOST_BENT = 0.85  # share of frames at which an interpolated line bends; above, each frame may be a sample
MOSTLY = 0.9  # of the samples: share that bends the line to one side only
OFTEN = 0.75  # quantile of an input's changes, over windows: a rare step does not count
LARGER = 2.0  # ratio of this quantile at a frame of windows to its mean over frames: there the input jumps


def noise_of(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of white noise in recorded states, from third differences of their samples.

    Zero differences, as from an encoder at rest, do not count.
    """
    thirds = [
        np.abs(np.concatenate([_thirds(*_samples(values)) for values in states]))
        for states in zip(*(rollout.states.T for rollout in rollouts), strict=True)
    ]
    moving = [each[each > LINEAR * each.max(initial=0.0)] for each in thirds]
    return np.array([robust_deviation(each) if len(each) else 0.0 for each in moving]) / np.sqrt(20.0)


def robust_deviation(sizes: Array) -> Array:
    """Standard deviations (...) of normal numbers from their sizes (k, ...), robust to outliers."""
    return np.asarray(np.median(sizes, axis=0) / 0.6745)


def smoothed(rollouts: Sequence[Rollout], frames: int, window: int = 0) -> list[Array]:
    """States (k + 1, n) of each rollout without most of their white noise.

    Each is the value of a polynomial fitted to neighbouring frames, at most `frames` to each side (A.
    Savitzky and M. J. E. Golay, Analytical Chemistry 36, 1964). For each state, the number of frames is
    chosen by leave-one-out cross-validation, robust to outliers. Where smoothing would remove more than
    noise, as at a collision, states stay as recorded. True states and rollouts that are too short are
    unchanged. Given the frames of windows, so are all states if inputs jump where windows begin: smoothing
    would bend each velocity there in the same way, and even bends smaller than noise move parameters far.
    """
    from scipy.signal import savgol_coeffs, savgol_filter  # lazily, as in `Actuators`: few need it

    noisy = [rollout.sensed and len(rollout.states) > 2 * frames for rollout in rollouts]
    long = list(compress(rollouts, noisy))
    if frames < FEWEST_AROUND or not long:
        return [rollout.states for rollout in rollouts]
    recorded = np.concatenate([rollout.states for rollout in long])
    best, least = recorded, np.full(recorded.shape[1], np.inf)
    around = np.full(recorded.shape[1], frames)  # frames to each side
    for half in np.unique(np.geomspace(FEWEST_AROUND, frames, WIDTHS).round().astype(int)).tolist():
        width = 2 * half + 1
        smooth = np.concatenate([savgol_filter(rollout.states, width, DEGREE, axis=0) for rollout in long])
        removed = np.abs(smooth - recorded)
        outlying = OUTLIER * robust_deviation(removed)
        kept, removed = np.where(removed > outlying, recorded, smooth), np.minimum(removed, outlying)
        weight = savgol_coeffs(width, DEGREE)[half]
        errors = np.mean((removed / (1.0 - weight)) ** 2, axis=0)
        better = errors < least
        best, around = np.where(better, kept, best), np.where(better, half, around)
        least = np.minimum(errors, least)
    if window and _jump(long, window, int(around.max()) // 2):
        return [rollout.states for rollout in rollouts]
    ends = np.cumsum([len(rollout.states) for rollout in long])[:-1]
    made = iter(np.split(best, ends))
    return [next(made) if each else rollout.states for rollout, each in zip(rollouts, noisy, strict=True)]


def _jump(rollouts: Sequence[Rollout], window: int, near: int) -> bool:
    """Whether an input jumps where windows begin, give or take `near` frames, rather than elsewhere."""
    parts = list[Array]()
    for rollout in rollouts:
        changes = np.abs(np.diff(rollout.inputs, axis=0, prepend=rollout.inputs[:1]))
        parts.append(changes[len(changes) % window :].reshape(-1, window, changes.shape[1]))
    windows = np.concatenate(parts)
    if not len(windows):
        return False
    sizes = np.quantile(windows, OFTEN, axis=0)  # (window, m), by the frame in a window
    return bool((sizes[np.arange(-near, near + 1) % window] > LARGER * sizes.mean(axis=0)).any())


def _samples(values: Array) -> tuple[Array, Array]:
    """Times in frames, and values, of a state's samples: all frames (k,), or fewer with lines between."""
    each = np.arange(float(len(values))), values
    bends = np.append(np.diff(values, 2), 0.0)  # at each frame except the first
    bent = np.abs(bends) > LINEAR * np.ptp(values)
    before = np.flatnonzero(bent)
    if len(before) < FEWEST or bent.mean() > MOST_BENT:
        return each
    # A sample between two frames bends the line at both, so every second frame of a run precedes a sample.
    runs = before[np.diff(before, prepend=-2) > 1]
    before = before[(before - runs[np.searchsorted(runs, before, side="right") - 1]) % 2 == 0]
    first, second = bends[before], np.where(bent[before + 1], bends[before + 1], 0.0)
    same = first * second >= 0.0  # an encoder's step bends the line to both sides
    before, share = before[same] + 1, second[same] / (first + second)[same]
    if len(before) < FEWEST or same.mean() < MOSTLY:
        return each
    times, slopes = before + share, values[before] - values[before - 1]
    least, most = np.quantile(np.diff(times), [0.1, 0.9])
    return (times, values[before] + share * slopes) if most <= EVEN * least else each


def _thirds(times: Array, values: Array) -> Array:
    """Third differences (k - 3,) of values (k,), divided by their spacing where it is uneven.

    The scaling keeps the effect of white noise the same as for even spacing.
    """
    if len(values) <= 3:
        return values[:0]
    spacing = np.median(np.diff(times))
    for order in (1, 2, 3):
        values = np.diff(values) * (order * spacing / (times[order:] - times[:-order]))
    four = np.lib.stride_tricks.sliding_window_view(times, 4)
    distances = (four[:, :, None] - four[:, None, :]) / spacing + np.eye(4)
    weights = 6.0 / np.prod(distances, axis=2)
    return np.asarray(values * np.sqrt(20.0 / np.sum(weights**2, axis=1)))
