"""Plans of a model, and the policy that follows one: feedforward, and gains of deviations that vary in time.

Gains are of states alone: what the state does not show has none.
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
from simbias.search.goal import goal_along, moves
from simbias.search.lqr import rest
from simbias.search.optimizer.riccati import regulator, solved
from simbias.simulation.linearization import advanced, derivatives, linear_regulator, linearization

STEP = 1e-3  # of differences: of states, and of inputs over their limits
STIFFER = 30.0  # times that gains at rest grow for the friction of joints without a motor
ALONG = 0.1  # share of a joint's friction that is not along the inputs' effect, below which they overcome it
BISECTIONS = 30
STAYS = 0.25  # s, for which it has to be
AT_REST = 0.5  # of each state, in its unit, within which a plan is as good as at rest
SETTLED = 1000  # frames, after which the gains of a rest are those of an infinite horizon


class Plan(NamedTuple):
    """A trajectory of the model."""

    states: Array  # (T+1, n)
    inputs: Array  # (T, m)
    cost: float
    held: Array | float = 0.0  # weights (c,) of squared criteria of failure, 1/s, for its gains


class Following:
    """Policies that follow plans of a model, as it is or as its joints slide, and the model's slopes there.

    Deviations weigh what the cost says of the goal's errors or, if it is not quadratic, 1 in each state's
    unit; along a plan that holds criteria of failure, also what these say.
    """

    def __init__(self, model: Model, weights: GoalWeights | None = None, sliding: bool = False) -> None:
        self._task, self._n, self._m = model.task, len(model.task.states), len(model.task.inputs)
        self._nominal, self._bias = model.nominal, model.bias
        self.sliding = model.nominal.without_dry_friction()
        self.model = replace(model, nominal=self.sliding) if sliding else model
        self._off_goal = None if weights is None else weights.errors  # (g,)

    def policies(self, plan: Plan, policy: Trajectory, input_weights: Sequence[float]) -> Iterator[Array]:
        """Parameters (p,) of the policy that follows a plan, for each weight of inputs at their limits.

        A goal about all states, where it does not move, is a rest: the last knot is there, its gains those of
        an infinite horizon.

        Of a plan as joints slide, inputs compensate for the friction along it, and there are gains for small
        deviations from rest, which count on the friction of joints that no input moves.
        """
        ahead, task = policy.frames_ahead, self._task
        slopes = self._slopes_at_once if ahead else self.slopes
        M, Q = slopes(plan.states, plan.inputs), self._state_weights(plan.states, plan.held)
        x, u = plan.states, np.concatenate([plan.inputs, plan.inputs[-1:]])
        final, settled = None, len(x)
        goal = goal_along(task)
        if task.goals == task.states and not moves(goal):
            x_rest, u_rest = rest(self.model, goal[-1])
            x_rest = x[-1] - wrapped(x[-1] - x_rest, task.states)
            final = slopes(np.tile(x_rest, (2, 1)), u_rest[None])
            x, u = np.concatenate([x[:-1], [x_rest]]), np.concatenate([u[:-1], [u_rest]])
            settled = self._settled(x, x_rest)
            if policy.sliding and settled < len(x):  # its last frames may leave again
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
        """K_t (T+1, m, n) along states (T+1, n) and inputs (T, m) that begin and end anywhere."""
        return self._gains(self.slopes(states, inputs), self._state_weights(states, held), weight, None)

    def goal_slopes(self, states: Array) -> Array:
        """Derivatives (T+1, g, n) of the goal's quantities along states (T+1, n)."""
        return derivatives(self._task.aim, states, np.full(self._n, STEP))

    def slopes(self, states: Array, inputs: Array) -> Array:
        """M (T, l, l+m) of the model with its model state, along states (T+1, n) and inputs (T, m).

        Its joints slide: dry friction is steep at rest.
        """
        model_state = self._nominal.model_states(states[:-1], inputs)
        points = np.concatenate([states[:-1], model_state, inputs], axis=-1)
        steps = STEP * np.concatenate([np.ones(self._n + model_state.shape[-1]), self._task.input_limit])
        return derivatives(partial(advanced, self.sliding, self._bias, self._n), points, steps)

    def _slopes_at_once(self, states: Array, inputs: Array) -> Array:
        """M (T, n, n+m), as `slopes`, as if inputs acted at once."""
        n, steps = self._n, STEP * np.concatenate([np.ones(self._n), self._task.input_limit])

        def after(points: Array) -> Array:
            x, u = points[..., :n], points[..., n:]
            return self.sliding.step(x, u) + self._bias.correction(x, u)

        return derivatives(after, np.concatenate([states[:-1], inputs], axis=-1), steps)

    def _settled(self, x: Array, x_rest: Array) -> int:
        """The first frame of `STAYS` in a row near rest, of states x (T+1, n); T+1 if there is none."""
        near = np.abs(x - x_rest).max(axis=-1) <= AT_REST
        stays = self._task.frames(STAYS)
        whole = np.convolve(near, np.ones(stays), "valid") == stays
        return int(np.argmax(whole)) if whole.any() else len(x)

    def _for_friction(self, x: Array, u: Array, weight: float) -> Array:
        """Further gains (m, n) at a rest x (n,) under u (m,), for the dry friction of some joints.

        At small velocities it is damping, the more the smaller they are, until no input moves the joints
        against it: gains grow without bound as it comes near to that. As much of it is counted on as lets
        them grow `STIFFER` times; none along the inputs' own effect, as an input overcomes that at once.
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
            K = regulated(middle)  # beyond, gains have the other sign
            fits = np.linalg.norm(K) < STIFFER * np.linalg.norm(soft) and np.sum(K * soft) > 0.0
            share, above = (middle, above) if fits else (share, middle)
        return regulated(share) - soft

    def _state_weights(self, states: Array, held: Array | float) -> Array:
        """Weights (T+1, n, n) of deviations from states (T+1, n), for gains; criteria as in a plan."""
        if self._off_goal is None:
            return np.tile(np.eye(self._n), (len(states), 1, 1))
        G = self.goal_slopes(states)
        Q = np.einsum("g,tgi,tgj->tij", self._off_goal, G, G)
        if np.any(held):
            C = derivatives(self._task.measure, states, np.full(self._n, STEP))
            Q += np.einsum("c,tci,tcj->tij", held, C, C)
        return Q

    def _gains(self, M: Array, Q: Array, weight: float, final: Array | None) -> Array:
        """K_t (T+1, m, n) of the time-varying regulator along M, which ends with that of the rest."""
        hidden = 0, M.shape[1] - self._n
        Q = np.pad(Q, ((0, 0), hidden, hidden))
        R, V = weight * np.diag(self._task.input_limit**-2.0), Q[-1]
        settled = np.empty((0, self._m, len(V)))
        if final is not None:
            _, settled, V = solved(regulator(np.repeat(final, SETTLED, axis=0), V, R, V), self._n)
        _, K, _ = solved(regulator(M, Q[:-1], R, V), self._n)
        return np.concatenate([K, settled[:1] if len(settled) else K[-1:]])[..., : self._n]

    def _compensation(self, states: Array, inputs: Array, ahead: int) -> Array:
        """Further inputs (T+1, m) that overcome dry friction at states (T+1, n) some frames later."""
        x = states[np.minimum(np.arange(len(states)) + ahead, len(states) - 1)]
        lost = self.sliding.step(x, inputs) - self._nominal.step(x, inputs)
        _, B = linearization(self.sliding, x, inputs, self._task.input_limit)
        return (np.linalg.pinv(B) @ lost[..., None])[..., 0]


def linear(frames: Array, given: Array, rows: Array) -> Array:
    """Rows (K, c) at frames (K,), linear between those (k, c) at given frames (k,)."""
    return np.stack([np.interp(frames, given, column) for column in rows.T], axis=-1)
