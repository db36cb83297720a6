"""Downsampling and the seven criteria of Section IV-C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from simbias.core import Nominal, Samples, Task
from simbias.core.ranges import Positive, Span, frames_in
from simbias.core.records import Array, Flags, Indices, Rollout, Selection, Transitions
from simbias.simulation.linearization import input_scale

RESIDUAL = "residual"  # criterion 7
OTHERS = "other_failure"  # failures by a criterion outside the task, such as the hardware's own


@dataclass(frozen=True)
class WindowLengths:
    """Length of a sample, a weighted mean, in frames or as a duration (`70 ms`)."""

    true_state: Span = 1
    measured: Span = 71


_WINDOWS = WindowLengths()


class Thresholds(Samples):
    """Select every `stride`-th transition whose two states keep the limits and whose residual is no outlier.

    Residuals of a single frame drown in sensor noise. Over a few frames the bias is nearly affine, so the
    mean of residuals is the residual at the mean state and input. The model's prediction in each frame uses
    the input that acted. This jumps from frame to frame when a policy feeds back noise; smoothing the states
    alone would mistake these jumps for noise. See `line_weights` for the weights.

    Parameters
    ----------
    stride
        Distance between samples: frames, or a duration such as `40 ms`, rounded to whole frames.
    limits
        Limits of the task's criteria by name; a criterion not named keeps the task's limit.
    residual
        Limit of criterion 7; None: reject no outliers.
    window
        Length of a sample, for each kind of recorded states: frames, or a duration.
    selection
        "stride", or "information": the same numbers of samples and rejections, but the samples farthest from
        each other among all that keep the limits.
    """

    def __init__(
        self,
        task: Task,
        stride: Span = 35,
        limits: Mapping[str, Positive] | None = None,
        residual: Positive | None = 0.01,
        window: WindowLengths = _WINDOWS,
        selection: Literal["stride", "information"] = "stride",
    ) -> None:
        names = [criterion.name for criterion in task.criteria]
        unknown = sorted(set(limits or {}) - set(names))
        if unknown:
            known = ", ".join(names)
            raise ValueError(f"limits: the task has no criterion {', '.join(unknown)}; available: {known}")
        if taken := sorted({RESIDUAL, OTHERS} & set(names)):
            raise ValueError(f"the task has a criterion {taken[0]}, a name that samples use themselves")
        self._task = task
        self._stride = frames_in(stride, task.time_step)
        self._limits = {c.name: c.limit for c in task.criteria} | dict(limits or {})
        self._limits[RESIDUAL] = np.inf if residual is None else residual
        self._true_state = frames_in(window.true_state, task.time_step)
        self._measured = frames_in(window.measured, task.time_step)
        self._selection = selection

    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        """Downsample; apply the criteria to states and residuals (Eq. 6); count the first that rejects."""
        every = Transitions.empty(len(self._task.states), len(self._task.inputs))
        verdicts, sampled = np.empty(0, np.int64), np.empty(0, np.bool_)
        for rollout in rollouts:
            candidates, judged = self._candidates(rollout, nominal)
            every, verdicts = every | candidates, np.append(verdicts, judged)
            sampled = np.append(sampled, np.arange(len(judged)) % self._stride == 0)
        accepted = verdicts < 0
        transitions = _chosen(every, sampled & accepted)
        if self._selection == "information":
            transitions = self._spread(_chosen(every, accepted), len(transitions))
        frames = sum(rollout.frames for rollout in rollouts)
        told = verdicts[sampled].tolist()
        rejected = {name: told.count(index) for index, name in enumerate(self._limits)}
        if others := told.count(len(rejected)):
            rejected[OTHERS] = others
        return Selection(transitions, frames, len(told), rejected, self._why_none(rollouts))

    def _window_of(self, rollout: Rollout) -> int:
        """The number of frames per sample of this rollout."""
        return self._measured if rollout.sensed else self._true_state

    def _why_none(self, rollouts: Sequence[Rollout]) -> str:
        """A message that no rollout is as long as one sample; empty if one is."""
        if not rollouts or any(rollout.frames >= self._window_of(rollout) for rollout in rollouts):
            return ""
        longest = max(rollouts, key=lambda rollout: rollout.frames)
        key = "measured" if longest.sensed else "true_state"
        window = self._window_of(longest)
        return (
            f"the longest experiment has {longest.frames} frames, fewer than the {window} of one sample "
            f"({window * self._task.time_step:g} s, samples.window.{key})"
        )

    def _candidates(self, rollout: Rollout, nominal: Nominal) -> tuple[Transitions, Indices]:
        """The samples beginning at each frame, and the index of the criterion that rejects each, or -1."""
        states, window = rollout.states, self._window_of(rollout)
        if rollout.frames < window:
            return Transitions.empty(states.shape[1], rollout.inputs.shape[1]), np.empty(0, np.int64)
        recorded, sent, earlier = rollout.with_history()
        residuals = states[1:] - nominal.along(recorded[:-1], sent)[earlier:]  # Eq. 6
        acted = nominal.acted_along(recorded[:-1], sent)[earlier:]
        weights = line_weights(window)
        columns = (states[:-1], acted, states[1:], residuals)
        x, u, x_next, residuals = (
            sliding_window_view(column, window, axis=0) @ weights for column in columns
        )
        verdicts = self._verdicts(x, x_next, residuals)
        if rollout.failed_at is not None:
            names = list(self._limits)
            failure = names.index(rollout.failure) if rollout.failure in names else len(names)
            verdicts[max(rollout.failed_at - window, 0) :] = failure
        return Transitions(np.concatenate([x, u], axis=1), residuals), verdicts

    def _verdicts(self, x: Array, x_next: Array, residuals: Array) -> Indices:
        """The first of the criteria 1-7 that rejects each sample from x (k, n) to x_next (k, n); else -1."""
        measures = np.maximum(self._task.measure(x), self._task.measure(x_next))
        sizes = np.linalg.norm(residuals, axis=1, keepdims=True)
        within = np.hstack([measures, sizes]) <= list(self._limits.values())
        return np.where(within.all(axis=1), -1, np.argmin(within, axis=1))

    def _spread(self, transitions: Transitions, count: int) -> Transitions:
        """Pick `count` transitions, each farthest from the earlier ones; inputs relative to their limits."""
        if not count:
            return transitions
        places = transitions.inputs.copy()
        places[:, len(self._task.states) :] /= input_scale(self._task)
        chosen, distance = [0], np.linalg.norm(places - places[0], axis=1)
        while len(chosen) < count:
            chosen.append(int(np.argmax(distance)))
            distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
        return _chosen(transitions, np.array(sorted(chosen)))


def _chosen(transitions: Transitions, rows: Flags | Indices) -> Transitions:
    return Transitions(transitions.inputs[rows], transitions.residuals[rows])


def line_weights(window: int) -> Array:
    """Weights (window,) of steps of measured states; the weighted mean is the least-squares line's slope.

    With independent errors of variance s^2 in the states, these weights minimise the variance of the mean: 12
    s^2 / (w (w+1) (w+2)), which is 2 s^2 for a single step (w = 1).
    """
    frame = np.arange(1, window + 1)
    parabola = frame * (window + 1.0 - frame)
    return parabola / parabola.sum()
