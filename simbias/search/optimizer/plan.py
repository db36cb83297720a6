"""A trajectory of a model, and the model's slopes along it."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from simbias.core import Model
from simbias.core.records import Array
from simbias.simulation.linearization import advanced, derivatives

STEP = 1e-3  # of differences: of states, and of inputs over their limits


class Plan(NamedTuple):
    """A trajectory of the model."""

    states: Array  # (T+1, n)
    inputs: Array  # (T, m)
    cost: float


class Slopes:
    """Derivatives of a model along trajectories, its joints sliding: dry friction is steep at rest."""

    def __init__(self, model: Model) -> None:
        self._task, self._nominal, self._bias = model.task, model.nominal, model.bias
        self.sliding = model.nominal.without_dry_friction()

    def of_goal(self, states: Array) -> Array:
        """Those (T+1, g, n) of the goal's quantities along states (T+1, n)."""
        return derivatives(self._task.aim, states, np.full(states.shape[1], STEP))

    def of_model(self, states: Array, inputs: Array) -> Array:
        """M (T, l, l+m) of the model with its model state, along states (T+1, n) and inputs (T, m)."""
        n, model_state = states.shape[1], self._nominal.model_states(states[:-1], inputs)
        points = np.concatenate([states[:-1], model_state, inputs], axis=-1)
        steps = STEP * np.concatenate([np.ones(n + model_state.shape[-1]), self._task.input_limit])
        return derivatives(partial(advanced, self.sliding, self._bias, n), points, steps)

    def at_once(self, states: Array, inputs: Array) -> Array:
        """M (T, n, n+m) of the model as if inputs acted at once, along states (T+1, n) and inputs (T, m)."""
        n = states.shape[1]
        steps = STEP * np.concatenate([np.ones(n), self._task.input_limit])

        def after(points: Array) -> Array:
            x, u = points[..., :n], points[..., n:]
            return self.sliding.step(x, u) + self._bias.correction(x, u)

        return derivatives(after, np.concatenate([states[:-1], inputs], axis=-1), steps)
