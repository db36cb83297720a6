"""White noise of recorded states, and states without most of it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np

from simbias.core.records import Array, Rollout

LINEAR = 1e-9  # of a state's range: a second difference that is rounding
FEWEST = 8  # samples that tell how often a state was measured
DEGREE = 4  # of polynomials, which keep the height of a motion's waves
FEWEST_AROUND = 3  # frames to each side of one that is smoothed
WIDTHS = 12  # numbers of frames that are tried
OUTLIER = 4.0  # deviations of noise
EVEN = 2.0  # long over short times between samples; between steps of an encoder they differ more
MOST_BENT = 0.85  # of the frames in which a line between samples bends; above, each may be a sample
MOSTLY = 0.9  # of the samples: those that bend it to one side alone


def noise_of(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of white noise in recorded states, from third differences of their samples.

    Those of zero, where an encoder rests, do not count.
    """
    thirds = [
        np.abs(np.concatenate([_thirds(*_samples(values)) for values in states]))
        for states in zip(*(rollout.states.T for rollout in rollouts), strict=True)
    ]
    moving = [each[each > LINEAR * each.max(initial=0.0)] for each in thirds]
    return np.array([robust_deviation(each) if len(each) else 0.0 for each in moving]) / np.sqrt(20.0)


def robust_deviation(sizes: Array) -> Array:
    """Standard deviations (...) of normal numbers of these sizes (k, ...), some of which may be outliers."""
    return np.asarray(np.median(sizes, axis=0) / 0.6745)


def smoothed(rollouts: Sequence[Rollout], frames: int) -> list[Array]:
    """States (k + 1, n) of each rollout without most of their white noise.

    Each is that of a polynomial through the frames around, at most `frames` to each side (A. Savitzky and
    M. J. E. Golay, Analytical Chemistry 36, 1964). For each state, their number is chosen by leave-one-out
    cross-validation, robust to outliers. Where more than noise would go, as at a collision, states stay as
    recorded; so do true ones, and rollouts of fewer frames.
    """
    from scipy.signal import savgol_coeffs, savgol_filter  # lazily, as of `Actuators`: few need it

    noisy = [rollout.sensed and len(rollout.states) > 2 * frames for rollout in rollouts]
    long = list(compress(rollouts, noisy))
    if frames < FEWEST_AROUND or not long:
        return [rollout.states for rollout in rollouts]
    recorded = np.concatenate([rollout.states for rollout in long])
    best, least = recorded, np.full(recorded.shape[1], np.inf)
    for half in np.unique(np.geomspace(FEWEST_AROUND, frames, WIDTHS).round().astype(int)).tolist():
        width = 2 * half + 1
        smooth = np.concatenate([savgol_filter(rollout.states, width, DEGREE, axis=0) for rollout in long])
        removed = np.abs(smooth - recorded)
        outlying = OUTLIER * robust_deviation(removed)
        unseen = np.minimum(removed, outlying) / (1.0 - savgol_coeffs(width, DEGREE)[half])
        errors = np.mean(unseen**2, axis=0)
        best = np.where(errors < least, np.where(removed > outlying, recorded, smooth), best)
        least = np.minimum(errors, least)
    ends = np.cumsum([len(rollout.states) for rollout in long])[:-1]
    made = iter(np.split(best, ends))
    return [next(made) if each else rollout.states for rollout, each in zip(rollouts, noisy, strict=True)]


def _samples(values: Array) -> tuple[Array, Array]:
    """When a state (k,) was measured, in frames, and what: in each, or more rarely and linear between."""
    each = np.arange(float(len(values))), values
    bends = np.append(np.diff(values, 2), 0.0)  # at each frame but the first
    bent = np.abs(bends) > LINEAR * np.ptp(values)
    before = np.flatnonzero(bent)
    if len(before) < FEWEST or bent.mean() > MOST_BENT:
        return each
    # A sample between two frames bends the line in both: every second frame of a run is before a sample.
    runs = before[np.diff(before, prepend=-2) > 1]
    before = before[(before - runs[np.searchsorted(runs, before, side="right") - 1]) % 2 == 0]
    first, second = bends[before], np.where(bent[before + 1], bends[before + 1], 0.0)
    same = first * second >= 0.0  # an encoder's step bends it to both sides
    before, share = before[same] + 1, second[same] / (first + second)[same]
    if len(before) < FEWEST or same.mean() < MOSTLY:
        return each
    times, slopes = before + share, values[before] - values[before - 1]
    least, most = np.quantile(np.diff(times), [0.1, 0.9])
    return (times, values[before] + share * slopes) if most <= EVEN * least else each


def _thirds(times: Array, values: Array) -> Array:
    """Third differences (k - 3,) of values (k,), divided by their spacing where it is uneven.

    White noise in the values makes them as large as those of evenly spaced ones.
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
