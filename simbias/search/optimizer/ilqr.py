"""Trajectories of a model that reach the task's goal, and policies that follow them.

A trajectory is found by iterative LQR (W. Li, E. Todorov, ICINCO 2004), with limited inputs: the model is
linearised along the last one, which makes the weighted errors and inputs a linear-quadratic problem, and the
step that solves it is shortened until the model's own rollout costs less. Rollouts are those of `Trajectory`
with a knot in every frame, so that limits, delays and failures are the model's. Gains are of states alone:
what the state does not show has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from simbias.core import GoalWeights, Model, Policy, Task, wrapped
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.lqr import rest
from simbias.search.optimizer.riccati import Quadratic, beside, regulator, solved
from simbias.simulation.closed_loop import simulator
from simbias.simulation.linearization import advanced, derivatives, linearization

ERROR_WEIGHT, RATE_WEIGHT = 1.0, 0.05  # of the goal's squared errors, 1/s; of those that are rates
FINAL_WEIGHT = 10.0  # in s: what they weigh at the end
INPUT_WEIGHT = 0.1  # of squared inputs at their limits, 1/s
SHARE = 0.8  # of the limits that a trajectory takes: what is left is for feedback
GAIN_WEIGHTS = (1.0, 10.0, 100.0)  # R of inputs at their limits; Q of a state of one unit is 1
STEP = 1e-3  # of differences: of states, and of inputs over their limits
STIFFER = 30.0  # times that gains at rest grow for the friction of joints without a motor
ALONG = 0.1  # share of a joint's friction that is not along the inputs' effect, below which they overcome it
BISECTIONS = 30
STAYS = 0.25  # s, for which it has to be
AT_REST = 0.5  # of each state, in its unit, within which a plan is as good as at rest
SHORTER = 0.5 ** np.arange(12)  # shares of a step that are tried, all at once
ITERATIONS = 200
PATIENCE, PROGRESS = 10, 0.01  # it ends where that many iterations save less than this share
LEAST, MOST = 1e-6, 1e8  # damping: where not even the most lets a step cost less, none does
FROM_REST, FROM_REST_PATIENCE = (
    1e6,
    3,
)  # damping that begins at rest, far from a goal that moves; patience there
PIECE, AMPLITUDE = 0.3, 0.6  # s, and share of the limits, of the random inputs that it begins with
SETTLED = 1000  # frames, after which the gains of a rest are those of an infinite horizon
SEED = 0  # of these inputs: the same model has the same trajectories


class Plan(NamedTuple):
    """A trajectory of the model."""

    states: Array  # (T+1, n)
    inputs: Array  # (T, m)
    cost: float


def trajectory_candidates(model: Model, count: int, weights: GoalWeights | None = None) -> Iterator[Array]:
    """Policies (p,) that follow the best of `count` trajectories, one for each weight of the inputs.

    A trajectory costs what the weights say, those of a cost that is quadratic about the goal; else there are
    weights of its own. Trajectories to a goal that rests begin with different random inputs, those to a goal
    that moves at rest. They are planned once the first policy is asked for, which a search that is replayed
    does not do.

    Raises
    ------
    ConfigError
        If the policy follows no trajectory, the model fails with any of the inputs, or the plan is to rest
        at a goal that moves.
    """
    if not count:
        return
    policy = follower(model.policy)
    shooting = Shooting(_shortened(model, policy.resting), weights, policy.sliding)
    plans = [shooting.plan(rng) for rng in np.random.default_rng(SEED).spawn(count)]
    found = [plan for plan in plans if plan is not None]
    if not found:
        raise ConfigError("method.trajectories", "the model fails whatever inputs a trajectory begins with")
    best = min(found, key=lambda plan: plan.cost)
    yield from shooting.following(best, policy, GAIN_WEIGHTS)


def _shortened(model: Model, resting: float) -> Model:
    """The model's task without the seconds at its end in which a plan rests."""
    task = model.task
    if not resting:
        return model
    if not np.array_equal(task.reference(0.0), task.reference(task.horizon * task.time_step)):
        raise ConfigError("policy.resting", "the task's goal moves; a plan rests at one that does not")
    return replace(model, task=task.with_horizon(task.horizon - task.frames(resting)))


def follower(policy: Policy) -> Trajectory:
    """The policy, which follows trajectories.

    Raises
    ------
    ConfigError
        If it does not.
    """
    if not isinstance(policy, Trajectory):
        problem = f"{type(policy).__name__} follows no trajectory; policy=trajectory does"
        raise ConfigError("method.trajectories", problem)
    return policy


def default_weights(task: Task) -> GoalWeights:
    """Weights of errors, of rates and of inputs at their limits, for costs that are not quadratic."""
    weights = np.where([goal.is_rate for goal in task.goals], RATE_WEIGHT, ERROR_WEIGHT)
    return GoalWeights(weights, INPUT_WEIGHT * task.input_limit**-2.0, FINAL_WEIGHT * weights)


class Shooting:
    """Trajectories of a model, as it is or as its joints slide, from the task's mean start to its goal."""

    def __init__(self, model: Model, weights: GoalWeights | None = None, sliding: bool = False) -> None:
        task = model.task
        self._sliding = model.nominal.without_dry_friction()  # friction is steep at rest
        self._nominal, self._slides = model.nominal, sliding
        model = replace(model, nominal=self._sliding) if sliding else model
        self._model, self._task = model, task
        self._n, self._m, self._T = len(task.states), len(task.inputs), task.horizon
        self._every_frame = Trajectory(task, model.nominal, task.horizon + 1)
        self._simulator = simulator(replace(model, policy=self._every_frame))
        goal = [task.reference(t) for t in task.time_step * np.arange(self._T + 1)]
        self._goal = np.array(goal)  # (T+1, g)
        self._moves = bool((self._goal != self._goal[0]).any())
        self._off_goal = None if weights is None else weights.errors  # (g,) what gains weigh; None: states
        weights = weights or default_weights(task)
        self._weights = np.tile(task.time_step * weights.errors, (self._T + 1, 1))  # (T+1, g)
        self._weights[-1] = weights.final
        self._input_weights = task.time_step * weights.inputs  # (m,)
        self._damping = np.diag(task.time_step * INPUT_WEIGHT * task.input_limit**-2.0)  # (m, m)

    def plan(self, rng: np.random.Generator) -> Plan | None:
        """A trajectory that begins with random inputs, or at rest if the goal moves; None where all fail."""
        best, costs = self._rest() if self._moves else self._first(rng), list[float]()
        damping, patience = (FROM_REST, FROM_REST_PATIENCE) if self._moves else (1.0, PATIENCE)
        while best is not None and damping < MOST and len(costs) < ITERATIONS:
            better = self._improved(best, damping)
            damping = damping * 10 if better is None else max(damping / 5, LEAST)
            if better is None:
                continue
            best, costs = better, [*costs, better.cost]
            if len(costs) > patience and costs[-1] > (1 - PROGRESS) * costs[-1 - patience]:
                break
        return best

    def following(self, plan: Plan, policy: Trajectory, input_weights: Sequence[float]) -> Iterator[Array]:
        """Parameters (p,) of the policy that follows a plan, for each weight of inputs at their limits.

        Beside them, deviations weigh what the cost says of the goal's errors or, if it is not quadratic, 1 in
        each state's unit. A goal about all states, where it does not move, is a rest: the last knot is there,
        its gains those of an infinite horizon.

        Of a plan as joints slide, inputs compensate for the friction along it, and there are gains for small
        deviations from rest, which count on the friction of joints that no input moves.
        """
        ahead = policy.frames_ahead
        linearised = self._at_once if ahead else self._linearised
        M, Q = linearised(plan.states, plan.inputs), self._state_weights(plan.states)
        x, u, final = plan.states, np.concatenate([plan.inputs, plan.inputs[-1:]]), None
        settled = len(x)
        if self._task.goals == self._task.states and not self._moves:
            x_rest, u_rest = rest(self._model, self._goal[-1])
            x_rest = x[-1] - wrapped(x[-1] - x_rest, self._task.states)
            x, u = np.concatenate([x[:-1], [x_rest]]), np.concatenate([u[:-1], [u_rest]])
            final = linearised(np.tile(x_rest, (2, 1)), u_rest[None])
            near = np.abs(x - x_rest).max(axis=-1) <= AT_REST
            stays = self._task.frames(STAYS)
            whole = np.convolve(near, np.ones(stays), "valid") == stays
            settled = int(np.argmax(whole)) if whole.any() else len(x)
            if policy.sliding and whole.any():  # its last frames may leave again
                x[-stays:], u[-stays:] = x_rest, u_rest
        if policy.sliding:
            u = u + self._compensation(x, u, ahead)
        frames = policy.times / self._task.time_step
        for weight in input_weights:
            gains, beside = self._gains(M, Q, weight, final), np.zeros((len(x), self._m, self._n))
            if policy.sliding and settled < len(x):
                beside[settled:] = self._for_friction(x_rest, u_rest, weight)
            K, K_0 = (_at(frames + ahead, each.reshape(len(x), -1)) for each in (gains, beside))
            yield policy.following(_at(frames + ahead, x), _at(frames, u), K, K_0)

    def _for_friction(self, x: Array, u: Array, weight: float) -> Array:
        """Further gains (m, n) at a rest x (n,) under u (m,), for the dry friction of some joints.

        At small velocities it is damping, the more the smaller they are, until no input moves the joints
        against it: gains grow without bound as it comes near to that. As much of it is counted on as lets
        them grow `STIFFER` times; none along the inputs' own effect, as an input overcomes that at once.
        """
        n, limit = self._n, self._task.input_limit
        sliding, B = linearization(self._sliding, x, u, limit)
        friction = linearization(self._nominal, x, u, limit)[0] - sliding
        others = friction - B @ np.linalg.lstsq(B, friction, rcond=None)[0]
        friction[:, np.linalg.norm(others, axis=0) <= ALONG * np.linalg.norm(friction, axis=0)] = 0.0
        R = weight * np.diag(limit**-2.0)

        def regulated(share: float) -> Array:
            A = sliding + share * friction
            S = solve_discrete_are(A, B, np.eye(n), R)
            K: Array = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
            return K

        soft, share, above = regulated(0.0), 0.0, float(friction.any())
        for _ in range(BISECTIONS):
            middle = 0.5 * (share + above)
            K = regulated(middle)  # beyond, gains have the other sign
            fits = np.linalg.norm(K) < STIFFER * np.linalg.norm(soft) and np.sum(K * soft) > 0.0
            share, above = (middle, above) if fits else (share, middle)
        return regulated(share) - soft

    def _state_weights(self, states: Array) -> Array:
        """Weights (T+1, n, n) of deviations from states (T+1, n), for gains."""
        if self._off_goal is None:
            return np.tile(np.eye(self._n), (len(states), 1, 1))
        G = self._slopes(states)
        return np.einsum("g,tgi,tgj->tij", self._off_goal, G, G)

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

    def _first(self, rng: np.random.Generator) -> Plan | None:
        """The best trajectory of random inputs and of smaller ones, as large ones may fail."""
        pieces = np.arange(0, self._T + 1, self._task.frames(PIECE))
        values = AMPLITUDE * rng.standard_normal((len(pieces), self._m)) * self._task.input_limit
        inputs = np.stack([np.interp(np.arange(self._T), pieces, each) for each in values.T], axis=-1)
        states = np.tile(self._task.start_mean, (self._T + 1, 1))
        return self._best(states, SHORTER[:, None, None] * inputs, np.zeros((self._T, self._m, self._n)))

    def _rest(self) -> Plan | None:
        """The start, or the rest that is nearest to it, held by a soft regulator."""
        x, u = rest(replace(self._model, nominal=self._sliding), self._task.start_mean)
        states, inputs = np.tile(x, (self._T + 1, 1)), np.tile(u, (self._T, 1))
        M = self._linearised(states, inputs)
        K = self._gains(M, self._state_weights(states), GAIN_WEIGHTS[-1], None)
        return self._best(states, inputs[None], K[:-1])

    def _improved(self, plan: Plan, damping: float) -> Plan | None:
        """A trajectory that costs less, if there is one."""
        task, weights = self._task, self._weights
        M = self._linearised(plan.states, plan.inputs)
        hidden = 0, M.shape[1] - self._n
        G = self._slopes(plan.states)
        e = task.aim(plan.states) - self._goal
        slope = np.pad(np.einsum("tg,tgn->tn", weights * e, G), ((0, 0), hidden))
        curvature = np.pad(np.einsum("tg,tgi,tgj->tij", weights, G, G), ((0, 0), hidden, hidden))
        W = beside(curvature[:-1], np.diag(self._input_weights))
        w = np.concatenate([slope[:-1], self._input_weights * plan.inputs], axis=1)
        room = tuple(SHARE * limits - plan.inputs for limits in task.input_bounds)
        problem = Quadratic(M, W, w, curvature[-1], slope[-1])
        try:
            k, K, _ = solved(problem, self._n, room, damping * self._damping)
        except np.linalg.LinAlgError:  # singular: it needs more damping
            return None
        inputs = plan.inputs + SHORTER[:, None, None] * k
        better = self._best(plan.states, inputs, K[..., : self._n])
        return better if better is not None and better.cost < plan.cost else None

    def _best(self, states: Array, inputs: Array, gains: Array) -> Plan | None:
        """The rollout that costs least of those with inputs (k, T, m) and gains (T, m, n) about states."""
        x, u, K = states[:-1], inputs, gains
        thetas = np.array(
            [self._every_frame.following(*(np.concatenate([a, a[-1:]]) for a in (x, each, K))) for each in u]
        )
        starts = np.tile(self._task.start_mean, (len(thetas), 1))
        plans = [
            Plan(rollout.states, rollout.inputs, self._cost(rollout.states, rollout.inputs))
            for rollout in self._simulator.rollouts(thetas, starts)
            if rollout.failed_at is None
        ]
        return min(plans, key=lambda plan: plan.cost, default=None)

    def _cost(self, states: Array, inputs: Array) -> float:
        """Half the weighted squares of errors and inputs."""
        e = self._task.aim(states) - self._goal
        return 0.5 * float(np.sum(self._weights * e**2) + np.sum(self._input_weights * inputs**2))

    def _slopes(self, states: Array) -> Array:
        """Derivatives (T+1, g, n) of the goal's quantities along states (T+1, n)."""
        return derivatives(self._task.aim, states, np.full(self._n, STEP))

    def _compensation(self, states: Array, inputs: Array, ahead: int) -> Array:
        """Further inputs (T+1, m) that overcome dry friction at states (T+1, n) some frames later."""
        x = states[np.minimum(np.arange(len(states)) + ahead, len(states) - 1)]
        lost = self._sliding.step(x, inputs) - self._nominal.step(x, inputs)
        _, B = linearization(self._sliding, x, inputs, self._task.input_limit)
        return (np.linalg.pinv(B) @ lost[..., None])[..., 0]

    def _at_once(self, states: Array, inputs: Array) -> Array:
        """M (T, n, n+m) of the model as if inputs acted at once, along states (T+1, n) and inputs (T, m)."""
        n, nominal, bias = self._n, self._sliding, self._model.bias
        steps = STEP * np.concatenate([np.ones(n), self._task.input_limit])

        def after(points: Array) -> Array:
            x, u = points[..., :n], points[..., n:]
            return nominal.step(x, u) + bias.correction(x, u)

        return derivatives(after, np.concatenate([states[:-1], inputs], axis=-1), steps)

    def _linearised(self, states: Array, inputs: Array) -> Array:
        """M (T, l, l+m) of the model with its model state, along states (T+1, n) and inputs (T, m)."""
        model_state = self._model.nominal.model_states(states[:-1], inputs)
        points = np.concatenate([states[:-1], model_state, inputs], axis=-1)
        steps = STEP * np.concatenate([np.ones(points.shape[-1] - self._m), self._task.input_limit])
        return derivatives(partial(advanced, self._sliding, self._model.bias, self._n), points, steps)


def _at(frames: Array, rows: Array) -> Array:
    """Rows (T+1, c) at frames (K,), linear between them."""
    return np.stack([np.interp(frames, np.arange(len(rows)), column) for column in rows.T], axis=-1)
