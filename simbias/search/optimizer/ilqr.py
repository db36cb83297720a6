"""Trajectories of a model that reach the task's goal.

A trajectory is found by iterative LQR (W. Li, E. Todorov, ICINCO 2004), with limited inputs. Linearising the
model along the last trajectory makes the weighted errors and inputs a linear-quadratic problem. The step that
solves it is shortened until the model's own rollout costs less. Rollouts use `Trajectory` with a knot in
every frame, so limits, delays and failures are those of the model.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from simbias.core import GoalWeights, Model, Task
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.lqr import rest
from simbias.search.optimizer.following import STEP, Following, Plan, linear
from simbias.simulation.closed_loop import simulator
from simbias.simulation.goal import goal_along
from simbias.simulation.linearization import LinearQuadratic, beside, derivatives, solved

ERROR_WEIGHT, RATE_WEIGHT = 1.0, 0.05  # of the goal's squared errors, 1/s; of rates
FINAL_WEIGHT = 10.0  # in s: factor of these weights at the end
INPUT_WEIGHT = 0.1  # of squared inputs at their limits, 1/s
SHARE = 0.8  # of the input limits for a step; feedback around the previous plan may use the rest
GAIN_WEIGHTS = (1.0, 10.0, 100.0)  # R of inputs at their limits; Q of a state of one unit is 1
SHORTER = 0.5 ** np.arange(12)  # fractions of a step, tried in lockstep
ITERATIONS = 200
PATIENCE, PROGRESS = 10, 0.01  # it ends when this many iterations save less than this share
PATIENT_ITERATIONS, PATIENT_PROGRESS = 500, 1e-4  # instead, for patient plans
LEAST, MOST = 1e-6, 1e8  # damping: if no step costs less even at the most, the search ends
FROM_REST, FROM_REST_PATIENCE = 1e6, 3  # damping and patience for trajectories that begin at rest
MARGINS = 0.5, 0.2, 0.05  # of the start's margin to a criterion's limit: nearer to it, a plan costs more
SAVED = 0.9  # a smaller margin is accepted if the cost falls below this share
KEEPING = 10.0 ** np.arange(2, 6)  # times the mean cost of resting: the cost of using up the margin
PIECE, AMPLITUDE = 0.3, 0.6  # s, and share of the limits, of the initial random inputs


def default_weights(task: Task) -> GoalWeights:
    """Default weights of errors, rates and inputs, for costs that are not quadratic."""
    weights = np.where([goal.is_rate for goal in task.goals], RATE_WEIGHT, ERROR_WEIGHT)
    return GoalWeights(weights, INPUT_WEIGHT * task.input_limit**-2.0, FINAL_WEIGHT * weights)


def _unfailing(task: Task) -> Task:
    """The task without failure criteria."""
    other = copy(task)
    other.criteria = tuple(each._replace(limit=np.inf) for each in task.criteria)
    return other


class Keeping(NamedTuple):
    """The cost of a plan that comes close to failure limits."""

    measure: Callable[[Array], Array]  # of states: measures (..., c) of the criteria
    weight: float  # of squared excesses
    inside: Array  # (c,) measures from which on the limits count as close
    spare: Array  # (c,) units of the excess

    def excess(self, states: Array) -> Array:
        """The excess (..., c) of states (..., n) over these measures, in their units."""
        return np.maximum(self.measure(states) - self.inside, 0.0) / self.spare


def _lasts(plan: Plan, task: Task) -> bool:
    """Whether a plan violates no criterion of a task."""
    return bool((task.violated(plan.states[1:]) < 0).all())


class Shooting:
    """Plans on a model, as it is or with sliding joints, from the task's mean start to its goal."""

    def __init__(
        self, model: Model, weights: GoalWeights | None = None, sliding: bool = False, patient: bool = False
    ) -> None:
        task = model.task
        self._patient = patient
        self.following = Following(model, weights, sliding)
        self._task, self._model, self._goal_weights, self._sliding = task, model, weights, sliding
        self._failed = False  # whether a rollout has failed
        self._keeping: Keeping | None = None
        self._frictionless = replace(model, nominal=self.following.sliding)
        self._n, self._m, self._T = len(task.states), len(task.inputs), task.horizon
        self._every_frame = Trajectory(task, model.nominal, task.horizon + 1)
        self._simulator = simulator(replace(self.following.model, policy=self._every_frame))
        self._goal = goal_along(task)  # (T+1, g)
        weights = weights or default_weights(task)
        self._weights = np.tile(task.time_step * weights.errors, (self._T + 1, 1))  # (T+1, g)
        self._weights[-1] = weights.final
        self._input_weights = task.time_step * weights.inputs  # (m,)
        self._damping = np.diag(task.time_step * INPUT_WEIGHT * task.input_limit**-2.0)  # (m, m)

    def plan(self, rng: np.random.Generator | None) -> Plan | None:
        """A trajectory that begins with random inputs, or at rest without them; None if all fail.

        If trajectories that begin at rest fail, the path to a successful one may lead through failing ones.
        If no successful one was found, the search is therefore repeated without failure criteria. If its
        result violates them, coming close to the limits is made ever more expensive until the trajectory
        lasts.
        """
        if rng is not None:
            first = self._first(rng)
            return first and self._descended(first, 1.0, PATIENCE)
        plan = self._from_rest()
        if plan is not None and (not self._failed or self._task.succeeds(plan.states)):
            return plan
        unlimited = replace(self._model, task=_unfailing(self._task))
        free = Shooting(unlimited, self._goal_weights, self._sliding, self._patient)
        other = free._from_rest()
        if other is not None and not _lasts(other, self._task):
            other = free._kept_within(self._task)
        if other is None or plan is None:
            return plan or other
        return min(plan, other, key=lambda each: each.cost)

    def along_knots(self, plan: Plan, times: Array) -> Plan | None:
        """The best rollout that follows a plan by its values at knot times (K,) alone; None if all fail."""
        knots, frames = times / self._task.time_step, np.arange(self._T + 1.0)
        found = list[Plan]()
        for weight in GAIN_WEIGHTS:
            K = self.following.gains(plan.states, plan.inputs, weight, plan.held)
            u = np.concatenate([plan.inputs, plan.inputs[-1:]])
            whole = plan.states, u, K.reshape(len(K), -1)
            x, u, K = (linear(frames, knots, linear(knots, frames, rows)) for rows in whole)
            rollout = self._best(x, u[None, :-1], K[:-1].reshape(self._T, self._m, self._n))
            found += [] if rollout is None else [rollout]
        return min(found, key=lambda each: each.cost, default=None)

    def _from_rest(self) -> Plan | None:
        """The trajectory found by descent from rest."""
        first = self._rest()
        return first and self._descended(first, FROM_REST, FROM_REST_PATIENCE)

    def _kept_within(self, task: Task) -> Plan | None:
        """A trajectory from rest that keeps away from the limits of a task's failure criteria, if possible.

        It comes closer to them only if that saves much.
        """
        first = self._rest()
        if first is None:
            return None
        limits = np.array([criterion.limit for criterion in task.criteria])
        left = limits - task.measure(task.start_mean)
        spare = np.where(np.isfinite(left) & (left > 0), left, 1.0)  # without a margin, one unit
        weights, per_second = KEEPING * first.cost / task.horizon, spare**-2.0 / task.time_step
        if not _lasts(first, task):
            first = self._rest(weights[0] * per_second) or first
        best = None
        for margin in MARGINS:
            inside = limits - margin * np.where(left > 0, spare, 0.0)
            plan, damping = (first, FROM_REST) if best is None else (best, 1.0)
            for weight in weights.tolist():
                self._keeping = Keeping(task.measure, weight, inside, spare)
                plan = self._descended(self._judged(plan.states, plan.inputs), damping, PATIENCE)
                damping = 1.0
                if _lasts(plan, task):
                    break
            self._keeping = None
            plan = self._judged(plan.states, plan.inputs)
            if _lasts(plan, task) and (best is None or plan.cost < SAVED * best.cost):
                best = plan._replace(held=weight * per_second)
        return best

    def _descended(self, best: Plan, damping: float, patience: int) -> Plan:
        """The trajectory found by steps of decreasing cost; the first step has this damping."""
        costs, begun = list[float](), damping <= 1.0
        most = PATIENT_ITERATIONS if self._patient else ITERATIONS
        progress = PATIENT_PROGRESS if self._patient else PROGRESS
        while damping < MOST and len(costs) < most:
            better = self._improved(best, damping)
            damping = damping * 10 if better is None else max(damping / 5, LEAST)
            if better is None:
                continue
            best, costs = better, [*costs, better.cost]
            begun = begun or damping <= 1.0  # with more, steps are short, and save little
            slow = len(costs) > patience and costs[-1] > (1 - progress) * costs[-1 - patience]
            if begun and slow:
                break
        return best

    def _first(self, rng: np.random.Generator) -> Plan | None:
        """The best trajectory among random inputs and scaled-down copies, as large inputs may fail."""
        pieces = np.arange(0, self._T + 1, self._task.frames(PIECE))
        values = AMPLITUDE * rng.standard_normal((len(pieces), self._m)) * self._task.input_limit
        inputs = np.stack([np.interp(np.arange(self._T), pieces, each) for each in values.T], axis=-1)
        states = np.tile(self._task.start_mean, (self._T + 1, 1))
        return self._best(states, SHORTER[:, None, None] * inputs, np.zeros((self._T, self._m, self._n)))

    def _rest(self, held: Array | float = 0.0) -> Plan | None:
        """The start, or the equilibrium nearest to it, held by a soft regulator; `held` as in a plan."""
        x, u = rest(self._frictionless, self._task.start_mean)
        states, inputs = np.tile(x, (self._T + 1, 1)), np.tile(u, (self._T, 1))
        K = self.following.gains(states, inputs, GAIN_WEIGHTS[-1], held)
        return self._best(states, inputs[None], K[:-1])

    def _improved(self, plan: Plan, damping: float) -> Plan | None:
        """A trajectory that costs less, if there is one."""
        task, weights = self._task, self._weights
        M = self.following.slopes(plan.states, plan.inputs)
        padding = 0, M.shape[1] - self._n
        G = self.following.goal_slopes(plan.states)
        e = task.aim(plan.states) - self._goal
        slope = np.pad(np.einsum("tg,tgn->tn", weights * e, G), ((0, 0), padding))
        curvature = np.pad(np.einsum("tg,tgi,tgj->tij", weights, G, G), ((0, 0), padding, padding))
        if keeping := self._keeping:
            E = derivatives(keeping.excess, plan.states, np.full(self._n, STEP))
            slope[:, : self._n] += keeping.weight * np.einsum("tc,tcn->tn", keeping.excess(plan.states), E)
            curvature[:, : self._n, : self._n] += keeping.weight * np.einsum("tci,tcj->tij", E, E)
        W = beside(curvature[:-1], np.diag(self._input_weights))
        w = np.concatenate([slope[:-1], self._input_weights * plan.inputs], axis=1)
        room = tuple(SHARE * limits - plan.inputs for limits in task.input_bounds)
        problem = LinearQuadratic(M, W, w, curvature[-1], slope[-1])
        try:
            k, K, _ = solved(problem, self._n, room, damping * self._damping)
        except np.linalg.LinAlgError:  # singular: needs more damping
            return None
        inputs = plan.inputs + SHORTER[:, None, None] * k
        better = self._best(plan.states, inputs, K[..., : self._n])
        return better if better is not None and better.cost < plan.cost else None

    def _best(self, states: Array, inputs: Array, gains: Array) -> Plan | None:
        """The cheapest rollout among inputs (k, T, m), with gains (T, m, n) around states."""
        x, u, K = states[:-1], inputs, gains
        thetas = np.array(
            [self._every_frame.following(*(np.concatenate([a, a[-1:]]) for a in (x, each, K))) for each in u]
        )
        starts = np.tile(self._task.start_mean, (len(thetas), 1))
        rollouts = self._simulator.rollouts(thetas, starts)
        plans = [
            self._judged(rollout.states, rollout.inputs) for rollout in rollouts if rollout.failed_at is None
        ]
        self._failed |= len(plans) < len(rollouts)
        return min(plans, key=lambda plan: plan.cost, default=None)

    def _judged(self, states: Array, inputs: Array) -> Plan:
        """A plan with its cost: half the weighted squares of errors, inputs, and excesses near limits."""
        e = self._task.aim(states) - self._goal
        cost = np.sum(self._weights * e**2) + np.sum(self._input_weights * inputs**2)
        if keeping := self._keeping:
            cost += keeping.weight * np.sum(keeping.excess(states) ** 2)
        return Plan(states, inputs, 0.5 * float(cost))
