"""Closed-loop rollouts in vectorised NumPy (Eq. 7, 9), for any components; reference of the compiled loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Cost, FittedBias, Model, failure_name
from simbias.core.records import Array, Disturbance, Indices, Rollout

MOST = 256  # rollouts in lockstep; limited by the memory of their records


def _in_numpy(bias: FittedBias, x: Array, u: Array) -> Array:
    """The correction (k, n) of a bias at x (k, n), u (k, m)."""
    return bias.correction(x, u)


@dataclass(frozen=True, eq=False)
class PlainSimulator:
    """The closed loop in NumPy, in one or several scenarios that share task and policy.

    All rollouts of a call are stepped in lockstep; those that have ended drop out.
    """

    models: Sequence[Model]  # one per scenario
    disturbances: Sequence[Disturbance | None]
    correct: Callable[[FittedBias, Array, Array], Array] = _in_numpy  # the correction of a bias, for each row

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon, in the first scenario."""
        return self.rollouts(theta[None], start[None])[0]

    def rollouts(self, thetas: Array, starts: Array, scenarios: Indices | None = None) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its scenario of (k,)."""
        scenarios = np.zeros(len(thetas), np.int64) if scenarios is None else scenarios
        rollouts = []
        for first in range(0, len(thetas), MOST):
            some = slice(first, first + MOST)
            rollouts += self._together(thetas[some], starts[some], scenarios[some])
        return rollouts

    def costs(
        self, cost: Cost, thetas: Array, starts: Array, scenarios: Indices | None = None
    ) -> tuple[Array, Indices]:
        """Costs (k,) of these rollouts, and their frames (k,)."""
        return costs_of(cost, self.rollouts(thetas, starts, scenarios))

    @np.errstate(all="ignore")  # an overflow is not finite, and counts as failed
    def _together(self, thetas: Array, starts: Array, scenarios: Indices) -> list[Rollout]:
        """Rollouts in lockstep, frame by frame."""
        task, policy, k = self.models[0].task, self.models[0].policy, len(thetas)
        states = np.empty((k, task.horizon + 1, len(task.states)))
        inputs = np.empty((k, task.horizon, len(task.inputs)))
        frames, violated = np.full(k, task.horizon), np.full(k, -1)
        states[:, 0] = shaped("starts", starts, k, len(task.states))
        going, policy_state = np.arange(k), np.zeros((k, policy.state_size))
        model_state = np.zeros((k, self.models[0].nominal.state_size))
        for t in range(task.horizon + 1):
            failing = task.violated(states[going, t])
            stay = failing < 0
            ended = going[~stay]
            frames[ended], violated[ended] = t, failing[~stay]
            if t == task.horizon or not stay.any():
                break
            if len(ended):
                going, policy_state, model_state = going[stay], policy_state[stay], model_state[stay]
            x, own = states[going, t], scenarios[going]
            seen, force = self._noise(x, own, t)
            time = t * task.time_step
            inputs[going, t], policy_state = policy.act(thetas[going], seen, time, policy_state)
            states[going, t + 1], model_state = self._step(x, inputs[going, t] + force, model_state, own)
        ends = zip(frames.tolist(), violated.tolist(), strict=True)
        return [record(task.criteria, x, u, *end) for x, u, end in zip(states, inputs, ends, strict=True)]

    def _noise(self, x: Array, scenarios: Indices, t: int) -> tuple[Array, Array | float]:
        """Measurements (k, n) of x (k, n), and the disturbance (k, m) of the inputs; 0 without noise."""
        noise = [disturbance for disturbance in self.disturbances if disturbance is not None]
        if not noise:
            return x.copy(), 0.0  # a policy may overwrite it
        sensors, inputs = np.array([d.sensors[t] for d in noise]), np.array([d.inputs[t] for d in noise])
        return x + sensors[scenarios], inputs[scenarios]

    def _step(self, x: Array, u: Array, model_state: Array, scenarios: Indices) -> tuple[Array, Array]:
        """The next states (k, n) and model states (k, s) by each scenario's model and bias (Eq. 7)."""
        robot = x.shape[1] - len(self.models[0].task.targets)
        x, targets = x[:, :robot], x[:, robot:]
        x_next, kept, g, acted = np.empty_like(x), np.empty_like(model_state), np.empty_like(x), u.copy()
        for nominal, rows in _rows_of([model.nominal for model in self.models], scenarios):
            if nominal.state_size:
                x_next[rows], kept[rows] = nominal.advance(x[rows], u[rows], model_state[rows])
                acted[rows] = nominal.acted(u[rows], kept[rows])
            else:
                x_next[rows] = nominal.step(x[rows], u[rows])
        for bias, rows in _rows_of([model.bias for model in self.models], scenarios):
            g[rows] = self.correct(bias, x[rows], acted[rows])
        return np.concatenate([x_next + g, targets], axis=1), kept


def _rows_of(parts: Sequence, scenarios: Indices) -> Iterator[tuple[Any, Any]]:
    """Parts of models, each once, with the rows that are simulated with it."""
    if all(part is parts[0] for part in parts):
        yield parts[0], slice(None)
    else:
        for index in np.unique(scenarios):
            yield parts[index], scenarios == index


def costs_of(cost: Cost, rollouts: Sequence[Rollout]) -> tuple[Array, Indices]:
    """Costs (k,) of rollouts, and their frames (k,)."""
    frames = np.array([rollout.frames for rollout in rollouts], dtype=np.int64)
    costs = [cost.of(rollout) for rollout in rollouts]
    for got in costs:
        if np.shape(got) or not np.isfinite(got):  # np.array([1.0]) is not a number
            raise ValueError(f"{type(cost).__name__}.of: expected a finite number, got {got}")
    return np.array(costs), frames


def shaped(name: str, given: Any, *shape: int) -> Array:
    """Check an argument's shape, as floats: compiled loops would read past the end of shorter arrays.

    Read-only ones are copied, as loops would be compiled again for them.
    """
    values = np.require(given, np.float64, ["C", "W", "E"])
    if values.shape != shape:
        raise ValueError(f"{name}: expected the shape {shape}, got {values.shape}")
    return values


def record(criteria: Sequence, states: Array, inputs: Array, frames: int, violated: int) -> Rollout:
    """The record of a rollout ended after `frames` frames by criterion `violated`, or the horizon if -1."""
    states, inputs = states[: frames + 1], inputs[:frames]
    if violated < 0:
        return Rollout(states, inputs)
    return Rollout(states, inputs, frames, failure_name(criteria, violated))
