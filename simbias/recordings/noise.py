"""Noise of recorded states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core.records import Array, Rollout

LINEAR = 1e-9  # of a state's range: a second difference that is rounding
FEWEST = 8  # samples that tell how often a state was measured
EVEN = 2.0  # long over short times between samples; between steps of an encoder they differ more


def noise_of(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of white noise in recorded states, from third differences of their samples.

    Those of zero, where an encoder rests, do not count.
    """
    thirds = [
        np.abs(np.concatenate([np.diff(_samples(values), 3) for values in states]))
        for states in zip(*(rollout.states.T for rollout in rollouts), strict=True)
    ]
    moving = [each[each > LINEAR * each.max(initial=0.0)] for each in thirds]
    return np.array([np.median(each) if len(each) else 0.0 for each in moving]) / 0.6745 / np.sqrt(20.0)


def _samples(values: Array) -> Array:
    """A state (k,) in each frame or, where it was measured less often and is linear between, when it was."""
    sizes = np.abs(np.diff(values, 2))
    bends = sizes > LINEAR * np.ptp(values)
    # A sample between two frames bends the line in both, in the nearer one more.
    samples = np.flatnonzero(bends[1:-1] & (sizes[1:-1] >= sizes[:-2]) & (sizes[1:-1] > sizes[2:])) + 2
    if len(samples) < FEWEST or bends.sum() > 2 * (len(samples) + 1):
        return values
    least, most = np.quantile(np.diff(samples), [0.1, 0.9])
    return values[samples] if most <= EVEN * least else values
