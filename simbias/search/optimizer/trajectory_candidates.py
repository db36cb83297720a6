"""Policies that follow trajectories of a model: with them, a search begins."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from simbias.core import GoalWeights, Model, Policy, SlowWarning, Task
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.goal import goal_along, moves
from simbias.search.optimizer.following import Plan
from simbias.search.optimizer.ilqr import GAIN_WEIGHTS, Shooting

DEARER = 1.5  # times a plan's cost: that of following it by its knots is told
SEED = 0  # of the random inputs that plans begin with: the same model has the same trajectories


def trajectory_candidates(
    models: Sequence[Model], count: int, weights: GoalWeights | None = None
) -> Iterator[Array]:
    """Policies (p,) that follow the best of `count` trajectories, one for each weight of the inputs.

    Trajectories to a goal that rests begin with different random inputs, the one to a goal that moves at
    rest; to one that leaves some states free, one begins at rest, too. They are of the first of the models
    that has any: a correction learned from few experiments may make a model fail whatever its inputs. Where
    random inputs fail on all models, a trajectory begins at rest; it is not tried before on the first model.
    A trajectory costs what the weights say, those of a cost that is quadratic about the goal; else there are
    weights of its own. They are planned once the first policy is asked for, which a search that is replayed
    does not do.

    Raises
    ------
    ConfigError
        If the policy follows no trajectory, all models fail with any of the inputs, or the plan is to rest
        at a goal that moves.
    """
    if not count:
        return
    task, policy = models[0].task, follower(models[0].task, models[0].policy)
    if policy.resting:  # the plan ends before, and rests
        task = task.with_horizon(task.horizon - task.frames(policy.resting))
    if moves(goal_along(task)):
        begun = [(0, 1)]  # with so many random inputs, and so often at rest
    else:
        begun = [(count, 0), (0, 1)] if task.goals == task.states else [(count, 1)]
    for (random, at_rest), model in product(begun, models):
        shooting = Shooting(replace(model, task=task), weights, policy.sliding)
        rngs = [*np.random.default_rng(SEED).spawn(random), *[None] * at_rest]
        found = [plan for plan in map(shooting.plan, rngs) if plan is not None]
        if found:
            best = min(found, key=lambda plan: plan.cost)
            followed = shooting.along_knots(best, policy.times)
            _warn_of_few_knots(best, followed, len(policy.times), models[0].task.horizon)
            yield from shooting.following.policies(best, policy, GAIN_WEIGHTS)
            return
    limits = zip(task.inputs, *task.input_bounds, strict=True)
    inputs = ", ".join(f"{each.name} from {least:g} to {most:g} {each.unit}" for each, least, most in limits)
    means = zip(task.states, task.start_mean, strict=True)
    start = ", ".join(f"{each.name} {mean:g} {each.unit}" for each, mean in means if mean) or "all states 0"
    problem = f"the model fails from its start ({start}) whatever inputs a trajectory begins with: {inputs}"
    raise ConfigError("method.trajectories", problem)


def follower(task: Task, policy: Policy) -> Trajectory:
    """The policy; ConfigError if it follows no trajectory, or its plan is to rest at a goal that moves."""
    if not isinstance(policy, Trajectory):
        problem = f"{type(policy).__name__} follows no trajectory; policy=trajectory does"
        raise ConfigError("method.trajectories", problem)
    if policy.resting and moves(goal_along(task)):
        raise ConfigError("policy.resting", "the task's goal moves; a plan rests at one that does not")
    return policy


def _warn_of_few_knots(plan: Plan, followed: Plan | None, knots: int, frames: int) -> None:
    """Warn of a plan that knots, between which its policy is linear, do not represent."""
    if followed is None or followed.cost > DEARER * plan.cost:
        then = "fails" if followed is None else f"costs {followed.cost:.3g}"
        message = (
            f"a plan costs {plan.cost:.3g} in simulation, but followed by policy.knots={knots} it {then}; "
            f"policy.knots={frames + 1} is one a frame"
        )
        warnings.warn(message, SlowWarning, stacklevel=3)
