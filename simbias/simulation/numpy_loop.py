"""Closed-loop rollouts in vectorised NumPy (Eq. 7, 9): for any components; the compiled loop's reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Cost, FittedBias, Model, Nominal, failure_name
from simbias.core.records import Array, Disturbance, Indices, Rollout

MOST = 256  # rollouts side by side: their records take memory


def _in_numpy(bias: FittedBias, x: Array, u: Array) -> Array:
    """What a bias adds (k, n) at x (k, n), u (k, m)."""
    return bias.correction(x, u)


@dataclass(frozen=True, eq=False)
class PlainSimulator:
    """The closed loop in NumPy, in one world or in several, which share task and policy.

    All rollouts of a call are stepped together; those that have ended drop out.
    """

    models: Sequence[Model]
    disturbances: Sequence[Disturbance | None]
    correct: Callable[[FittedBias, Array, Array], Array] = _in_numpy  # what a bias adds to each row

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon, in the first world."""
        return self.rollouts(theta[None], start[None])[0]

    def rollouts(self, thetas: Array, starts: Array, worlds: Indices | None = None) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its world of (k,)."""
        worlds = np.zeros(len(thetas), np.int64) if worlds is None else worlds
        rollouts = []
        for first in range(0, len(thetas), MOST):
            some = slice(first, first + MOST)
            rollouts += self._together(thetas[some], starts[some], worlds[some])
        return rollouts

    def costs(
        self, cost: Cost, thetas: Array, starts: Array, worlds: Indices | None = None
    ) -> tuple[Array, Indices]:
        """Costs (k,) of these rollouts, and their frames (k,)."""
        return costs_of(cost, self.rollouts(thetas, starts, worlds))

    def _together(self, thetas: Array, starts: Array, worlds: Indices) -> list[Rollout]:
        """All of them, frame by frame."""
        task, policy, k = self.models[0].task, self.models[0].policy, len(thetas)
        states = np.empty((k, task.horizon + 1, len(task.states)))
        inputs = np.empty((k, task.horizon, len(task.inputs)))
        frames, violated = np.full(k, task.horizon), np.full(k, -1)
        states[:, 0] = starts
        going, memory = np.arange(k), np.zeros((k, policy.memory_size))
        hidden = np.zeros((k, self.models[0].nominal.memory_size))
        for t in range(task.horizon + 1):
            failing = task.violated(states[going, t])
            stay = failing < 0
            ended = going[~stay]
            frames[ended], violated[ended] = t, failing[~stay]
            if t == task.horizon or not stay.any():
                break
            if len(ended):
                going, memory, hidden = going[stay], memory[stay], hidden[stay]
            x, own = states[going, t], worlds[going]
            seen, unknown = self._noise(x, own, t)
            inputs[going, t], memory = policy.act(thetas[going], seen, t * task.time_step, memory)
            u = inputs[going, t] + unknown
            f, hidden = self._advance(x, u, hidden, own)
            g = self._by_world(self.correct, [model.bias for model in self.models], x, u, own)
            states[going, t + 1] = f + g
        return [self._record(*each) for each in zip(states, inputs, frames, violated, strict=True)]

    def _noise(self, x: Array, worlds: Indices, t: int) -> tuple[Array, Array | float]:
        """What the policies see of x (k, n), and what acts besides their inputs: (k, m), or nothing."""
        noise = [disturbance for disturbance in self.disturbances if disturbance is not None]
        if not noise:
            return x, 0.0
        return x + np.array([d.sensors[t] for d in noise])[worlds], np.array([d.inputs[t] for d in noise])[
            worlds
        ]

    def _advance(self, x: Array, u: Array, hidden: Array, worlds: Indices) -> tuple[Array, Array]:
        """What each world's nominal model makes of its rows, and what it then keeps (k, s)."""
        models = [model.nominal for model in self.models]
        if not hidden.shape[1]:
            return self._by_world(_step, models, x, u, worlds), hidden
        f, kept = np.empty_like(x), np.empty_like(hidden)
        for world in np.unique(worlds):
            rows = worlds == world
            f[rows], kept[rows] = models[world].advance(x[rows], u[rows], hidden[rows])
        return f, kept

    def _by_world(
        self,
        function: Callable[[Any, Array, Array], Array],
        parts: Sequence,
        x: Array,
        u: Array,
        worlds: Indices,
    ) -> Array:
        """What a function (k, n) of each world's part gives for its rows of x (k, n) and u (k, m)."""
        if all(part is parts[0] for part in parts):
            return function(parts[0], x, u)
        values = np.empty_like(x)
        for world in np.unique(worlds):
            rows = worlds == world
            values[rows] = function(parts[world], x[rows], u[rows])
        return values

    def _record(self, states: Array, inputs: Array, frames: int, violated: int) -> Rollout:
        """The record of a rollout."""
        return record(self.models[0].task.criteria, states, inputs, int(frames), int(violated))


def _step(model: Nominal, x: Array, u: Array) -> Array:
    """x_next (k, n) of x (k, n) under u (k, m)."""
    return model.step(x, u)


def costs_of(cost: Cost, rollouts: Sequence[Rollout]) -> tuple[Array, Indices]:
    """Costs (k,) of rollouts, and their frames (k,)."""
    frames = np.array([rollout.frames for rollout in rollouts], dtype=np.int64)
    costs = np.array([cost.of(rollout) for rollout in rollouts])
    if not np.isfinite(costs).all():
        got = costs[~np.isfinite(costs)][0]
        raise ValueError(f"{type(cost).__name__}.of: expected a finite number, got {got}")
    return costs, frames


def record(criteria: Sequence, states: Array, inputs: Array, frames: int, violated: int) -> Rollout:
    """The record of a rollout that a criterion ended after so many frames, or the horizon if it is -1."""
    states, inputs = states[: frames + 1], inputs[:frames]
    return (
        Rollout(states, inputs)
        if violated < 0
        else Rollout(states, inputs, frames, failure_name(criteria, violated))
    )
