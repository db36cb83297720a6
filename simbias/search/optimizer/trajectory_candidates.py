"""Policies that follow trajectories planned on a model, as candidates for a search."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from simbias.core import GoalWeights, Model, Policy, StudyWarning, Task
from simbias.core.errors import ConfigError
from simbias.core.policy import same_policy
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer.following import Plan
from simbias.search.optimizer.ilqr import GAIN_WEIGHTS, Shooting
from simbias.simulation.goal import goal_along, moves

DEARER = 1.5  # times a plan's cost: if following its knots costs more, a warning says so
SEED = 0  # of the plans' initial random inputs, so that the same model gives the same trajectories


def trajectory_candidates(
    models: Sequence[Model],
    count: int,
    weights: GoalWeights | None = None,
    refuted: Sequence[Array] = (),
    patient: bool = False,
) -> Iterator[Array]:
    """Policies (p,) that follow the best of `count` trajectories, one for each weight of the inputs.

    Trajectories to a resting goal begin with different random inputs; the one to a moving goal begins at
    rest. If a resting goal leaves some states free, one more begins at rest. They are planned on the first of
    the models that allows any: a correction learned from few experiments may make a model fail whatever its
    inputs. If random inputs fail on all models, a trajectory that begins at rest is tried. If the best one
    misses the goal, and the hardware has refuted (p,) a policy that follows it, others are planned from new
    random inputs. Trajectories are weighted as in a cost that is quadratic about the goal; otherwise there
    are default weights. Planning starts when the first policy is requested, which a replayed search does not
    do.

    ConfigError if the policy follows no trajectory, all models fail with all inputs tried, or the plan would
    have to rest at a moving goal.
    """
    if not count:
        return
    task, policy = models[0].task, follower(models[0].task, models[0].policy)
    if policy.resting:  # the plan ends earlier, and then rests
        task = task.with_horizon(task.horizon - task.frames(policy.resting))
    if moves(goal_along(task)):
        begun = [(0, 1)]  # counts: with random inputs, and at rest
    else:
        begun = [(count, 0), (0, 1)] if task.goals == task.states else [(count, 1)]
    for (random, at_rest), model in product(begun, models):
        shooting = Shooting(replace(model, task=task), weights, policy.sliding, patient)
        best = _planned(shooting, task, policy, random, at_rest, refuted)
        if best is not None:
            followed = shooting.along_knots(best, policy.times)
            _warn_of_few_knots(best, followed, len(policy.times), models[0].task)
            yield from shooting.following.policies(best, policy, GAIN_WEIGHTS)
            return
    limits = zip(task.inputs, *task.input_bounds, strict=True)
    inputs = ", ".join(f"{each.name} from {least:g} to {most:g} {each.unit}" for each, least, most in limits)
    means = zip(task.states, task.start_mean, strict=True)
    start = ", ".join(f"{each.name} {mean:g} {each.unit}" for each, mean in means if mean) or "all states 0"
    problem = f"the model fails from its start ({start}), whichever inputs a trajectory begins with: {inputs}"
    raise ConfigError("method.trajectories", problem)


def _planned(
    shooting: Shooting, task: Task, policy: Trajectory, random: int, at_rest: int, refuted: Sequence[Array]
) -> Plan | None:
    """The best of so many plans; if it misses the goal and is refuted, that of other random inputs."""
    rng, best = np.random.default_rng(SEED), None
    for rests in (at_rest, *[0] * len(refuted)):
        plans = [shooting.plan(each) for each in (*rng.spawn(random), *[None] * rests)]
        best = min(filter(None, plans), key=lambda plan: plan.cost, default=best)
        if best is None or task.succeeds(best.states) is not False:
            break
        plan = policy.planned(next(shooting.following.policies(best, policy, GAIN_WEIGHTS)))
        if not any(same_policy(policy.planned(theta), plan) for theta in refuted):
            break
    return best


def follower(task: Task, policy: Policy) -> Trajectory:
    """The policy; ConfigError if it follows no trajectory, or would have to rest at a moving goal."""
    if not isinstance(policy, Trajectory):
        problem = f"{type(policy).__name__} follows no trajectory; policy=trajectory does"
        raise ConfigError("method.trajectories", problem)
    if policy.resting and moves(goal_along(task)):
        raise ConfigError("policy.resting", "must be 0: a plan cannot rest at a goal that moves")
    return policy


def _warn_of_few_knots(plan: Plan, followed: Plan | None, knots: int, task: Task) -> None:
    """Warn if the knots, between which the policy is linear, do not represent a plan well."""
    misses = followed is not None and task.succeeds(plan.states) and not task.succeeds(followed.states)
    if followed is None or misses or followed.cost > DEARER * plan.cost:
        missing = "misses its goal and " * bool(misses)
        then = "fails" if followed is None else f"{missing}costs {followed.cost:.3g}"
        message = (
            f"a plan costs {plan.cost:.3g} in simulation, but followed with policy.knots={knots} it {then}; "
            f"policy.knots={task.horizon + 1} has one per frame"
        )
        warnings.warn(message, StudyWarning, stacklevel=3)
