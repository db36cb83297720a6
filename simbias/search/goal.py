"""The task's goal over time, as what is planned and regulated meets it."""

from __future__ import annotations

import numpy as np

from simbias.core import Task
from simbias.core.records import Array
from simbias.core.robot import unwound


def goal_along(task: Task) -> Array:
    """The goal's quantities (T+1, g), frame by frame.

    Those that wrap are without jumps by a turn, and begin within half a turn of the mean start.
    """
    goal = np.array([task.reference(t) for t in task.time_step * np.arange(task.horizon + 1)])
    turns = np.array([each.turn for each in task.goals])
    away = task.aim(task.start_mean) - goal[0]
    return unwound(goal, task.goals) + turns * np.round(away / np.where(turns, turns, 1.0))


def moves(goal: Array) -> bool:
    """Whether a goal (T+1, g) changes with time."""
    return bool((goal != goal[0]).any())


def resting_goal(task: Task) -> Array | None:
    """The states (n,) that are the goal, where it is about all of them, does not move and is not zero."""
    if task.goals != task.states:
        return None
    goal = goal_along(task)
    return goal[0] if goal[0].any() and not moves(goal) else None
