"""How far identified parameters would move if the model were integrated with shorter steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import final

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.problem import WindowErrors
from simbias.simulation.open_loop import plain, predict

STEPS = (10, 16), (40, 64), (160, 256)  # per frame; the model's own steps may be as short as the first ones
AGREE = 0.5  # of the change: if the changes of a pair differ more, shorter steps are tried
SAME_RATE = 0.3  # of the rates in two short frames: if they differ more, the model has its own substeps


@final
class Refined(Nominal):
    """A model whose frames each consist of several shorter frames of another model."""

    def __init__(self, model: Nominal, frames: int) -> None:
        self._model, self._frames = model, frames
        self.parameters = model.parameters

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n), all short frames of one frame after x (..., n) under u (..., m)."""
        for _ in range(self._frames):
            x = self._model.step(x, u)
        return x

    def with_parameters(self, values: Array) -> Refined:
        """The model with other values (k,) of its parameters."""
        return Refined(self._model.with_parameters(values), self._frames)

    def without_input_limits(self) -> Refined:
        """The refined model without input limits."""
        return Refined(self._model.without_input_limits(), self._frames)

    def rate(self, x: Array, u: Array) -> Array:
        """The change (..., n) over a frame at the rate of its first short frame."""
        return self._frames * (self._model.step(x, u) - x)


def moved_by_shorter_steps(
    task: Task,
    nominal: Nominal,
    nominal_of: Callable[[Task], Nominal],
    posterior: Posterior,
    fitted: Identified,
    rollouts: Sequence[Rollout],
    recordings: Sequence[str],
) -> Array | None:
    """How far (r, p) the modes of r recordings would move, in their standard deviations, to first order.

    r is 1 if all recordings share all parameters. None if the model cannot be built for shorter frames, has
    a model state, or has its own substeps that do not divide a frame.
    """
    if nominal.state_size or fitted.errors is None:
        return None
    windows, known = posterior.windows(rollouts, recordings), posterior.known_prior(nominal)

    def mode_of(recording: int) -> Array:
        mode = fitted.of_recording(recording).mode
        return mode if known is None else known.numbers(mode)

    def errors_of(model: Nominal, predict: Callable[..., Array]) -> WindowErrors:
        return WindowErrors(posterior.known_prior(model) or posterior.prior(model), windows, predict)

    coarse = errors_of(nominal, predict)
    coarse.errors = fitted.errors
    z = coarse.coordinates(mode_of)
    errors = coarse.prediction_errors(z[None])[0]
    for pair in STEPS:
        try:
            refined = [_refined(nominal_of, task, steps) for steps in pair]
        except Exception:  # a custom model may refuse
            return None
        if refined[0].parameters != nominal.parameters:
            return None
        # In NumPy: they predict only once, and compiling would take longer.
        fine = [errors_of(each, plain) for each in refined]
        shorter, shortest = (each.prediction_errors(z[None])[0] - errors for each in fine)
        if _differ(shorter, shortest) <= AGREE:
            # Extrapolation for a first-order integrator.
            limit = shortest + (shortest - shorter) / (pair[1] / pair[0] - 1)
            moved = coarse.shift(z, limit)[np.unique(coarse.places, axis=0)]
            covariances = [fitted.of_recording(i).covariance for i in range(len(moved))]
            moved = moved if known is None else known.deviations(moved)
            return np.asarray(np.abs(moved) / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))
        if _differ(*(each.rate(windows.begin, windows.inputs) for each in refined)) > SAME_RATE:
            return None
    return None


def _differ(one: Array, other: Array) -> float:
    """The distance of two arrays relative to the size of the second."""
    return float(np.linalg.norm(other - one) / max(np.linalg.norm(other), np.finfo(float).tiny))


def _refined(nominal_of: Callable[[Task], Nominal], task: Task, steps: int) -> Refined:
    """The model with this many steps per frame."""
    shorter = copy(task)
    shorter.time_step = task.time_step / steps
    return Refined(nominal_of(shorter), steps)
