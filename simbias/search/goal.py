"""The task's goal over time, for planning and regulation."""

from __future__ import annotations

import warnings

import numpy as np

from simbias.core import SlowWarning, Task, wrapped
from simbias.core.quantities import unwound
from simbias.core.records import Array


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
        warnings.warn(words, SlowWarning, stacklevel=2)
        return None
    return x if x.any() else None
