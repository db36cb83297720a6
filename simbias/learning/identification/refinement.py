"""How far identified parameters would move if their model were integrated in shorter steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import final

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.problem import Comparison
from simbias.simulation.open_loop import plain

SHORTER, SHORTEST = 10, 16  # steps of a frame
AGREE = 0.5  # of what they change: where these two differ more, the model has steps of its own


@final
class Refined(Nominal):
    """A model whose frames are each several of another model's, which are shorter."""

    def __init__(self, model: Nominal, frames: int) -> None:
        self._model, self._frames = model, frames
        self.parameters = model.parameters

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n), so many short frames after x (..., n) under u (..., m)."""
        for _ in range(self._frames):
            x = self._model.step(x, u)
        return x

    def with_parameters(self, values: Array) -> Refined:
        """The model with other values (k,) of its parameters."""
        return Refined(self._model.with_parameters(values), self._frames)

    def without_input_limits(self) -> Refined:
        """That of the model, in as many frames."""
        return Refined(self._model.without_input_limits(), self._frames)


def moved_by_shorter_steps(
    task: Task,
    nominal: Nominal,
    nominal_of: Callable[[Task], Nominal],
    posterior: Posterior,
    fitted: Identified,
    rollouts: Sequence[Rollout],
    recordings: Sequence[str],
) -> Array:
    """How far (p,) the mode would move, in its standard deviations, to first order.

    Zeros of a model that cannot be made for shorter frames, or that remembers its last ones, or has steps of
    its own, of which frames are no whole number; and where an earlier posterior is known.
    """
    still = np.zeros(len(fitted.parameters))
    # The precision of an earlier posterior is not at hand.
    if nominal.state_size or fitted.errors is None or posterior.begins_with_known:
        return still
    try:
        refined = [_refined(nominal_of, task, steps) for steps in (SHORTER, SHORTEST)]
    except Exception:  # an own model may refuse
        return still
    if refined[0].parameters != nominal.parameters:
        return still
    windows = posterior.windows(rollouts, recordings)
    coarse = Comparison(posterior.prior(nominal), windows)
    coarse.errors = fitted.errors
    z = coarse.coordinates(fitted)
    # In NumPy: they predict once, and to compile them would take longer.
    fine = [Comparison(posterior.prior(each), windows, plain) for each in refined]
    errors, *others = (each.prediction_errors(z[None])[0] for each in (coarse, *fine))
    shorter, shortest = (each - errors for each in others)
    if np.linalg.norm(shortest - shorter) > AGREE * np.linalg.norm(shortest):
        return still
    return np.abs(coarse.shift(z, shortest)[: len(still)]) / np.sqrt(np.diag(fitted.covariance))


def _refined(nominal_of: Callable[[Task], Nominal], task: Task, steps: int) -> Refined:
    """The model in so many steps of a frame."""
    shorter = copy(task)
    shorter.time_step = task.time_step / steps
    return Refined(nominal_of(shorter), steps)
