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

STEPS = 8  # of a frame
ANOTHER = 0.5  # of what the robot moves by in a window: a model that differs more does not know its frames


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


def moved_by_shorter_steps(
    task: Task,
    nominal_of: Callable[[Task], Nominal],
    posterior: Posterior,
    fitted: Identified,
    rollouts: Sequence[Rollout],
    recordings: Sequence[str],
) -> Array:
    """How far (p,) the mode would move, in its standard deviations, to first order.

    Zeros of a model that cannot be made for shorter frames, or that remembers its last ones.
    """
    nominal, still = nominal_of(task), np.zeros(len(fitted.parameters))
    shorter = copy(task)
    shorter.time_step = task.time_step / STEPS
    try:
        refined = Refined(nominal_of(shorter), STEPS)
    except Exception:  # an own model may refuse
        return still
    if nominal.state_size or refined.parameters != nominal.parameters or fitted.errors is None:
        return still
    windows = posterior.windows(rollouts, recordings)
    coarse = Comparison(posterior.prior(nominal), windows)
    fine = Comparison(posterior.prior(refined), windows, plain)  # once: to compile it would take longer
    coarse.errors = fitted.errors
    z = coarse.coordinates(fitted)
    difference = fine.prediction_errors(z[None])[0] - coarse.prediction_errors(z[None])[0]
    moves = windows.means - windows.begin[windows.starts][:, None]
    if not (np.std(difference, axis=(0, 1)) <= ANOTHER * np.std(moves, axis=(0, 1))).all():
        return still
    shift = coarse.shift(z, difference)[: len(still)]
    return np.abs(shift) / np.sqrt(np.diag(fitted.covariance))
