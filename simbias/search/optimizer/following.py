"""Plans on a model, and the policy that follows one: feedforward and time-varying feedback gains.

Gains act on states alone, not on the model state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from simbias.core import GoalWeights, Model, wrapped
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.lqr import rest
from simbias.simulation.goal import goal_at_rest
from simbias.simulation.linearization import (
    advanced,
    derivatives,
    linear_regulator,
    linearization,
    regulation,
    solved,
)

STEP = 1e-3  # step of differences: of states, and of inputs relative to their limits
STIFFER = 30.0  # factor by which gains at rest may grow for the friction of joints without a motor
ALONG = 0.1  # share of a joint's friction not along the inputs' effect; below it, inputs overcome it
BISECTIONS = 30
STAYS = 0.25  # s, minimum duration at rest
AT_REST = 0.5  # of each state, in its unit: a plan within it counts as at rest
SETTLED = 1000  # frames, after which gains at rest are those of an infinite horizon


class Plan(NamedTuple):
    """A trajectory of the model."""

    states: Array  # (T+1, n)
    inputs: Array  # (T, m)
    cost: float
    held: Array | float = 0.0  # weights (c,) of squared failure criteria, 1/s, for its gains


class Following:
    """Policies that follow plans on a model, as it is or with sliding joints, and linearisations along them.

    Deviations are weighted as goal errors in the cost or, if it is not quadratic, by 1 in each state's unit;
    along a plan that limits failure criteria, their weights are added.
    """

    def __init__(self, model: Model, weights: GoalWeights | None = None, sliding: bool = False) -> None:
        self._task, self._n, self._m = model.task, len(model.task.states), len(model.task.inputs)
        self._nominal, self._bias = model.nominal, model.bias
        self.sliding = model.nominal.without_dry_friction()
        self.model = replace(model, nominal=self.sliding) if sliding else model
        self._off_goal = None if weights is None else weights.errors  # (g,)

    def policies(self, plan: Plan, policy: Trajectory, input_weights: Sequence[float]) -> Iterator[Array]:
        """Parameters (p,) of the policy that follows a plan, for each weight of inputs at their limits.

        If the goal does not move and determines all states at rest, it is an equilibrium: the last knot lies
        there, with the gains of an infinite horizon.

        For a plan with sliding joints, inputs compensate for the friction along it. Further gains act on
        small deviations from rest; they rely on the friction of joints that no input moves.
        """
        ahead, task = policy.frames_ahead, self._task
        slopes = self._slopes_at_once if ahead else self.slopes
        M, Q = slopes(plan.states, plan.inputs), self._state_weights(plan.states, plan.held)
        x, u = plan.states, np.concatenate([plan.inputs, plan.inputs[-1:]])
        final, settled = None, len(x)
        if (goal := goal_at_rest(task, x[-1])) is not None:
            x_rest, u_rest = rest(self.model, goal, any_input=True)
            x_rest = x[-1] - wrapped(x[-1] - x_rest, task.states)
            final = slopes(np.tile(x_rest, (2, 1)), u_rest[None])
            x, u = np.concatenate([x[:-1], [x_rest]]), np.concatenate([u[:-1], [u_rest]])
            settled = self._settled(x, x_rest)
            if policy.sliding and settled < len(x):  # its last frames may leave rest again
                stays = task.frames(STAYS)
                x[-stays:], u[-stays:] = x_rest, u_rest
        if policy.sliding:
            u = u + self._compensation(x, u, ahead)
        frames, whole = policy.times / task.time_step, np.arange(float(len(x)))
        for weight in input_weights:
            gains, beside = self._gains(M, Q, weight, final), np.zeros((len(x), self._m, self._n))
            if policy.sliding and settled < len(x):
                beside[settled:] = self._for_friction(x_rest, u_rest, weight)
            K, K_0 = (linear(frames + ahead, whole, each.reshape(len(x), -1)) for each in (gains, beside))
            yield policy.following(linear(frames + ahead, whole, x), linear(frames, whole, u), K, K_0)

    def gains(self, states: Array, inputs: Array, weight: float, held: Array | float = 0.0) -> Array:
        """K_t (T+1, m, n) along states (T+1, n) and inputs (T, m) with any start and end."""
        return self._gains(self.slopes(states, inputs), self._state_weights(states, held), weight, None)

    def goal_slopes(self, states: Array) -> Array:
        """Derivatives (T+1, g, n) of the goal's quantities along states (T+1, n)."""
        return derivatives(self._task.aim, states, np.full(self._n, STEP))

    def slopes(self, states: Array, inputs: Array) -> Array:
        """M (T, l, l+m), the linearised model with its model state, along states (T+1, n) and inputs (T, m).

        The joints slide, because dry friction is steep at rest.
        """
        model_state = self._nominal.model_states(states[:-1], inputs)
        points = np.concatenate([states[:-1], model_state, inputs], axis=-1)
        steps = STEP * np.concatenate([np.ones(self._n + model_state.shape[-1]), self._task.input_limit])
        return derivatives(partial(advanced, self.sliding, self._bias, self._n), points, steps)

    def _slopes_at_once(self, states: Array, inputs: Array) -> Array:
        """M (T, n, n+m), like `slopes`, as if inputs acted at once."""
        n, steps = self._n, STEP * np.concatenate([np.ones(self._n), self._task.input_limit])

        def after(points: Array) -> Array:
            x, u = points[..., :n], points[..., n:]
            return self.sliding.step(x, u) + self._bias.correction(x, u)

        return derivatives(after, np.concatenate([states[:-1], inputs], axis=-1), steps)

    def _settled(self, x: Array, x_rest: Array) -> int:
        """The first frame of a stay of `STAYS` near rest, in states x (T+1, n); T+1 if there is none."""
        near = np.abs(x - x_rest).max(axis=-1) <= AT_REST
        stays = self._task.frames(STAYS)
        whole = np.convolve(near, np.ones(stays), "valid") == stays
        return int(np.argmax(whole)) if whole.any() else len(x)

    def _for_friction(self, x: Array, u: Array, weight: float) -> Array:
        """Further gains (m, n) at a rest x (n,) under u (m,), for the dry friction of some joints.

        At small velocities, dry friction acts as damping that increases as they decrease, until no input can
        move the joints; gains grow without bound towards that point. The assumed friction lets them grow at
        most `STIFFER` times. None is assumed along the inputs' own effect, as an input overcomes it at once.
        """
        n, limit = self._n, self._task.input_limit
        sliding, B = linearization(self.sliding, x, u, limit)
        friction = linearization(self._nominal, x, u, limit)[0] - sliding
        others = friction - B @ np.linalg.lstsq(B, friction, rcond=None)[0]
        friction[:, np.linalg.norm(others, axis=0) <= ALONG * np.linalg.norm(friction, axis=0)] = 0.0
        R = weight * np.diag(limit**-2.0)

        def regulated(share: float) -> Array:
            return linear_regulator(sliding + share * friction, B, np.eye(n), R)[0]

        soft, share, above = regulated(0.0), 0.0, float(friction.any())
        for _ in range(BISECTIONS):
            middle = 0.5 * (share + above)
            K = regulated(middle)  # beyond, gains change their sign
            fits = np.linalg.norm(K) < STIFFER * np.linalg.norm(soft) and np.sum(K * soft) > 0.0
            share, above = (middle, above) if fits else (share, middle)
        return regulated(share) - soft

    def _state_weights(self, states: Array, held: Array | float) -> Array:
        """Weights (T+1, n, n) of deviations from states (T+1, n), for gains; `held` as in a plan."""
        if self._off_goal is None:
            return np.tile(np.eye(self._n), (len(states), 1, 1))
        G = self.goal_slopes(states)
        Q = np.einsum("g,tgi,tgj->tij", self._off_goal, G, G)
        if np.any(held):
            C = derivatives(self._task.measure, states, np.full(self._n, STEP))
            Q += np.einsum("c,tci,tcj->tij", held, C, C)
        return Q

    def _gains(self, M: Array, Q: Array, weight: float, final: Array | None) -> Array:
        """K_t (T+1, m, n) of the time-varying regulator along M, ending with the regulator at rest."""
        padding = 0, M.shape[1] - self._n
        Q = np.pad(Q, ((0, 0), padding, padding))
        R, V = weight * np.diag(self._task.input_limit**-2.0), Q[-1]
        settled = np.empty((0, self._m, len(V)))
        if final is not None:
            _, settled, V = solved(regulation(np.repeat(final, SETTLED, axis=0), V, R, V), self._n)
        _, K, _ = solved(regulation(M, Q[:-1], R, V), self._n)
        return np.concatenate([K, settled[:1] if len(settled) else K[-1:]])[..., : self._n]

    def _compensation(self, states: Array, inputs: Array, ahead: int) -> Array:
        """Additional inputs (T+1, m) that overcome dry friction at states (T+1, n), `ahead` frames later."""
        x = states[np.minimum(np.arange(len(states)) + ahead, len(states) - 1)]
        lost = self.sliding.step(x, inputs) - self._nominal.step(x, inputs)
        _, B = linearization(self.sliding, x, inputs, self._task.input_limit)
        return (np.linalg.pinv(B) @ lost[..., None])[..., 0]


def linear(frames: Array, given: Array, rows: Array) -> Array:
    """Interpolate rows (k, c) at given frames (k,) linearly to rows (K, c) at frames (K,)."""
    return np.stack([np.interp(frames, given, column) for column in rows.T], axis=-1)
