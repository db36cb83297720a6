"""Noise of recorded states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core.records import Array, Rollout


def noise_of(rollouts: Sequence[Rollout]) -> Array:
    """Standard deviations (n,) of white noise in recorded states, from their third differences."""
    thirds = np.concatenate([np.diff(rollout.states, 3, axis=0) for rollout in rollouts])
    deviations: Array = np.median(np.abs(thirds), axis=0) / 0.6745 / np.sqrt(20.0)
    return deviations
