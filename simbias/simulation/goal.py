"""The task's goal over time, and inputs that hold it, for planning and regulation."""

from __future__ import annotations

import warnings

import numpy as np

from simbias.core import Nominal, StudyWarning, Task, wrapped
from simbias.core.quantities import rate_pairs, unwound
from simbias.core.records import Array
from simbias.simulation.linearization import STEP, input_scale, linearization

BALANCED, ROUNDS = 1e-9, 5  # negligible change of states per frame, in their units; steps of the search
FAR = 1e9  # an error that is no number
MET = 1e-6  # of a goal's error, and of the slopes by which it determines states: none
SLIGHT = 0.01  # of the inputs' largest effect on a state in a frame: states that change less are held


def goal_along(task: Task) -> Array:
    """The goal's quantities (T+1, g), frame by frame.

    Quantities that wrap are unwound, and begin within half a turn of the mean start.
    """
    goal = np.array([task.reference(t) for t in task.time_step * np.arange(task.horizon + 1)])
    turns = np.array([each.turn for each in task.goals])
    away = task.aim(task.start_mean) - goal[0]
    return unwound(goal, task.goals) + turns * np.round(away / np.where(turns, turns, 1.0))


def moves(goal: Array) -> bool:
    """Whether a goal (T+1, g) changes with time."""
    return bool((goal != goal[0]).any())


def resting_goal(task: Task) -> Array | None:
    """The states (n,) of a goal that does not move; states outside the goal are zero.

    None if all are zero, or if the goal is stated in outputs, with a warning.
    """
    goal = goal_along(task)
    if moves(goal):
        return None
    named = dict(zip((each.name for each in task.goals), goal[0], strict=True))
    x = np.array([named.get(state.name, 0.0) for state in task.states])
    if not np.allclose(wrapped(task.aim(x) - goal[0], task.goals), 0.0):
        words = f"LQR regulates to zero, because the goal is for outputs ({', '.join(named)}), not states"
        warnings.warn(words, StudyWarning, stacklevel=2)
        return None
    return x if x.any() else None


def goal_at_rest(task: Task, near: Array) -> Array | None:
    """The states (n,), near others, in which a goal that does not move is met at rest.

    None if it moves, cannot be met at rest, or does not determine all other states.
    """
    from scipy.optimize import least_squares  # lazily, as below

    goal, still = goal_along(task), [rate for _, rate in rate_pairs(task.states)]
    if moves(goal):
        return None
    if task.goals == task.states:
        return np.array(goal[-1])
    end = task.horizon * task.time_step

    def errors(x: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.nan_to_num(
                np.concatenate([task.error(x, end), x[still]]), nan=FAR, posinf=FAR, neginf=-FAR
            )

    found = least_squares(errors, near, xtol=1e-12)
    met = np.abs(found.fun).max() <= MET and np.linalg.matrix_rank(found.jac, MET) == len(near)
    return np.array(found.x) if met else None


def holding(task: Task, nominal: Nominal, x: Array) -> Array:
    """Inputs (m,) within the limits under which states x (n,) change least, with sliding joints."""
    from scipy.optimize import lsq_linear  # lazily: few policies need it

    nominal, limit = nominal.without_dry_friction(), input_scale(task)
    lower, upper = task.input_bounds
    room = np.minimum(STEP * limit, 0.49 * (upper - lower))  # differences stay within the limits
    lower, upper = lower + room, upper - room
    u = np.clip(np.zeros(len(limit)), lower, upper)
    for _ in range(ROUNDS):
        moved = nominal.step(x, u) - x
        if not BALANCED < np.abs(moved).max() < np.inf:
            break
        B = linearization(nominal, x, u, limit)[1]
        if not np.isfinite(B).all():
            break
        u = u + lsq_linear(B, -moved, (lower - u, upper - u)).x
    return u


def held(task: Task, nominal: Nominal, x: Array) -> bool:
    """Whether inputs within the limits can hold states x (n,); true if the model has no slope there."""
    from scipy.optimize import lsq_linear  # lazily, as above

    limit, (lower, upper) = input_scale(task), task.input_bounds
    with np.errstate(all="ignore"):  # a model may have no slope there, as the root of a level of zero
        u = holding(task, nominal, x)
        B = linearization(nominal.without_dry_friction(), x, u, limit)[1]
        moved = nominal.step(x, u) - x
        if not (np.isfinite(B).all() and np.isfinite(moved).all()):
            return True
        nearer = nominal.step(x, u + lsq_linear(B, -moved, (lower - u, upper - u)).x) - x  # up to the limits
    least = min(np.abs(each).max() for each in (moved, nearer) if np.isfinite(each).all())
    return bool(least <= SLIGHT * np.abs(B * limit).max())


def goal_held(task: Task, nominal: Nominal) -> bool:
    """Whether inputs can hold the goal, with its positions at rest.

    Also true if it moves, leaves other states free, or is not where the task succeeds: none may be declared.
    """
    goal = goal_along(task)
    named = dict(zip((each.name for each in task.goals), goal[0], strict=True))
    pairs = rate_pairs(task.states)
    rests = {task.states[rate].name for position, rate in pairs if task.states[position].name in named}
    free = [each for each in task.states if each.name not in named.keys() | rests]
    if moves(goal) or free or task.targets:
        return True
    x = np.array([named.get(each.name, 0.0) for each in task.states])
    if task.succeeds(np.tile(x, (task.horizon + 1, 1))) is False or held(task, nominal, x):
        return True
    states, u = [x], holding(task, nominal, x)
    with np.errstate(all="ignore"):
        while len(states) <= task.horizon and np.isfinite(states[-1]).all():
            states.append(nominal.step(states[-1], u))  # on a floor, a robot stays near its goal
    return len(states) > task.horizon and task.succeeds(np.array(states)) is True
