"""White noise in recorded states: its size, and smoothing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from math import factorial, prod

import numpy as np

from simbias.core.records import Array, Rollout

ORDERS = range(3, 9)  # of differences
FEWEST = 20  # differences needed for an order above the lowest
LINEAR = 1e-9  # of the largest difference: smaller ones are rounding
DEGREE = 4  # of polynomials, which preserve the amplitude of oscillations
FEWEST_AROUND = 3  # frames to each side of a smoothed one
WIDTHS = 12  # candidate numbers of frames
OUTLIER = 4.0  # deviations of noise
OFTEN = 0.75  # quantile of an input's changes, over windows: a rare step does not count
LARGER = 2.0  # ratio of this quantile at a frame of windows to its mean over frames: there the input jumps


def noise_of(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of white noise in recorded states: known from their samples, or estimated."""
    known = [rollout.noise for rollout in rollouts if rollout.noise is not None]
    if len(known) == len(rollouts):
        frames = [len(rollout.states) for rollout in rollouts]
        return np.sqrt(np.average(np.square(known), axis=0, weights=frames))
    columns = zip(*(rollout.states.T for rollout in rollouts), strict=True)
    return np.array([white_noise([(np.arange(float(len(x))), x) for x in states]) for states in columns])


def white_noise(runs: Sequence[tuple[Array, Array]]) -> float:
    """The standard deviation of white noise in samples, from their differences of high order.

    Each run has times (k,) and values (k,). The order is the one with the smallest result, as the less motion
    remains, the smaller it is. Zero differences, as from an encoder at rest, do not count. 0.0 if there are
    too few samples.
    """
    found = list[float]()
    for order in ORDERS:
        sizes = np.abs(np.concatenate([_differences(order, times, values) for times, values in runs]))
        moving = sizes[sizes > LINEAR * sizes.max(initial=0.0)]
        if len(moving) >= (FEWEST if found else 1):
            found.append(float(robust_deviation(moving)))
    return min(found, default=0.0)


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


def _differences(order: int, times: Array, values: Array) -> Array:
    """Differences of some order of values (k,), divided by their spacing where it is uneven.

    They are scaled so that white noise does not change its standard deviation.
    """
    if len(values) <= order:
        return values[:0]
    spacing = np.median(np.diff(times))
    for each in range(1, order + 1):
        values = np.diff(values) * (each * spacing / (times[each:] - times[:-each]))
    nodes = [times[each : each + len(values)] / spacing for each in range(order + 1)]
    weights = (factorial(order) / prod(x - y for y in nodes if y is not x) for x in nodes)
    return np.asarray(values / np.sqrt(sum(weight**2 for weight in weights)))
