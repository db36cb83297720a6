"""Downsampling and the seven criteria of Section IV-C."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import PositiveFloat, PositiveInt

from simbias.interfaces import Nominal, Samples, Task
from simbias.records import Array, Rollout, Selection, Transitions


@dataclass(frozen=True)
class Windows:
    """Of how many frames a sample is the weighted mean."""

    true_state: PositiveInt = 1
    measured: PositiveInt = 71


_WINDOWS = Windows()


class _Sample(NamedTuple):
    """A transition, or the weighted mean of successive ones."""

    x: Array  # (n,)
    u: Array  # (m,)
    x_next: Array  # (n,)
    residual: Array  # (n,)
    failure: str | None  # the criterion by which the robot had failed at its end


class Thresholds(Samples):
    """Every `stride`-th transition whose two states keep the limits and whose residual is no outlier.

    Residuals of a millisecond drown in the sensors' noise. Over a few frames the bias is nearly affine, so
    the mean of residuals is the residual at the mean state and input. The model's part of each is computed
    with the input that acted, which jumps from frame to frame when a policy feeds noise back: a smoother of
    the states alone would take these jumps for noise. See `line_weights` for the weights.

    Parameters
    ----------
    limits
        Those of the task's criteria by name; a criterion that is not named keeps the task's own.
    residual
        Limit of criterion 7.
    window
        Frames of a sample, for either kind of recorded states.
    selection
        "stride", or "information": as many samples, and as many rejected, but among all that keep the limits
        those that lie farthest from each other.
    """

    def __init__(
        self,
        task: Task,
        stride: PositiveInt = 35,
        limits: Mapping[str, PositiveFloat] | None = None,
        residual: PositiveFloat = 0.01,
        window: Windows = _WINDOWS,
        selection: Literal["stride", "information"] = "stride",
    ) -> None:
        names = [criterion.name for criterion in task.criteria]
        unknown = sorted(set(limits or {}) - set(names))
        if unknown:
            raise ValueError(f"limits names no criterion of the task: {', '.join(unknown)}; it has {names}")
        self._task = task
        self._stride = stride
        self._limits = {c.name: c.limit for c in task.criteria} | dict(limits or {})
        self._residual = residual
        self._window = window
        self._selection = selection

    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Downsample; judge states and residuals (Eq. 6) by the criteria; count what each rejects first."""
        samples = [list(self._samples(rollout, nominal)) for rollout in rollouts]
        sampled = [sample for of_rollout in samples for sample in of_rollout[:: self._stride]]
        verdicts = [self._rejected_by(sample) for sample in sampled]
        rejected = {name: verdicts.count(name) for name in (*self._limits, "residual")}
        kept = [sample for sample, verdict in zip(sampled, verdicts, strict=True) if verdict is None]
        if self._selection == "information":
            good = [s for of_rollout in samples for s in of_rollout if self._rejected_by(s) is None]
            kept = self._spread(good, len(kept))
        frames = sum(rollout.frames for rollout in rollouts)
        return Selection(self._transitions(kept), frames, len(sampled), rejected)

    def _samples(self, rollout: Rollout, nominal: Nominal) -> Iterator[_Sample]:
        """The samples that begin at each frame."""
        states, inputs = rollout.states, rollout.inputs
        window = self._window.measured if rollout.sensed else self._window.true_state
        if rollout.frames < window:
            return
        predicted = np.array([nominal.step(x, u) for x, u in zip(states, inputs, strict=False)])
        residuals = states[1:] - predicted  # Eq. 6
        weights = line_weights(window)
        columns = (states[:-1], inputs, states[1:], residuals)
        means = [sliding_window_view(column, window, axis=0) @ weights for column in columns]
        names = {criterion.words: criterion.name for criterion in self._task.criteria}
        for first, (x, u, x_next, residual) in enumerate(zip(*means, strict=True)):
            failed = rollout.failed_at is not None and first + window >= rollout.failed_at
            yield _Sample(x, u, x_next, residual, names.get(rollout.failure or "") if failed else None)

    def _rejected_by(self, sample: _Sample) -> str | None:
        """The first of the criteria 1-7 that rejects a sample."""
        if sample.failure is not None:
            return sample.failure
        worst = np.maximum(self._task.measure(sample.x), self._task.measure(sample.x_next))
        for measure, (name, limit) in zip(worst, self._limits.items(), strict=True):
            if not measure <= limit:
                return name
        return None if np.linalg.norm(sample.residual) <= self._residual else "residual"

    def _spread(self, samples: Sequence[_Sample], count: int) -> list[_Sample]:
        """So many samples, each the farthest from those before it; inputs count in units of their limits."""
        if not count:
            return []
        places = np.array([np.concatenate([s.x, s.u / self._task.input_limit]) for s in samples])
        chosen, distance = [0], np.linalg.norm(places - places[0], axis=1)
        while len(chosen) < count:
            chosen.append(int(np.argmax(distance)))
            distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
        return [samples[index] for index in sorted(chosen)]

    def _transitions(self, samples: Sequence[_Sample]) -> Transitions:
        """Samples as training data."""
        n, m = len(self._task.states), len(self._task.inputs)
        inputs = np.array([np.concatenate([sample.x, sample.u]) for sample in samples])
        residuals = np.array([sample.residual for sample in samples])
        return Transitions(inputs.reshape(-1, n + m), residuals.reshape(-1, n))


def line_weights(window: int) -> Array:
    """Weights (window,) of steps of measured states, whose mean is the slope of the least-squares line.

    With independent errors of variance s^2 in the states, no other weights give less variance to the mean:
    12 s^2 / (w (w+1) (w+2)), so 2 s^2 for a single step (w = 1).
    """
    frame = np.arange(1, window + 1)
    parabola = frame * (window + 1.0 - frame)
    return parabola / parabola.sum()
