"""Conditions of a declared task that count the turns of an angle, as is hardly meant."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Callable, Mapping

import numpy as np

from simbias.core import StudyWarning, Task
from simbias.core.records import Array
from simbias.core.task_checks import drawn_starts
from simbias.robots.declared.declarations import Failure, bound_of, within_abs

SHARES = np.linspace(0.0, 1.0, 361)  # of a turn: where failures are sought

Alone = Callable[[int, Array], Array]  # measures (k, c) of failure at values (k,) of the state of this index


def warn_of_turns(
    task: Task, where: Mapping[str, str], conditions: Mapping[str, Failure], alone: Alone
) -> None:
    """Warn if a condition uses an angle that wraps outside of sin and cos, where its turns count.

    Conditions are named by their keys, and may use the expressions of `where`. `alone` measures failure where
    nothing but one state is known. A bound beyond half a turn on an angle is meant to count turns.
    """
    turning = _turning(task, alone)
    angles = {name: name for name in turning}
    for key, text in (*where.items(), *((key, each.value) for key, each in conditions.items())):
        for name in sorted(angles.keys() & _outside(text)):
            angles[key] = angles[name]
    meant = {key for key, each in conditions.items() if _bounds_turns(each, turning)}
    for key in [key for key in conditions if key in angles.keys() - meant][:1]:
        angle = angles[key]
        words = f"{key} counts the turns of {angle}, which wraps: after a whole turn it is not zero again; "
        words += f"sin({angle}), cos({angle}) and the goal's error do not count them"
        warnings.warn(words, StudyWarning, stacklevel=4)


def _turning(task: Task, alone: Alone) -> dict[str, float]:
    """Half a turn of each angle that may make a whole one: no failure stops it, whatever the others."""
    turning = dict[str, float]()
    if not any(each.wraps for each in task.states):
        return turning
    starts = drawn_starts(task, np.random.default_rng(0))
    begun = starts[task.violated(starts) < 0]
    limits = np.array([criterion.limit for criterion in task.criteria])

    def last(index: int, way: Array) -> float:
        """The last value on a way (k,) along which the task fails nowhere."""
        failing = np.flatnonzero((alone(index, way) > limits).any(axis=1))
        return float(way[max(failing.min(initial=len(way)) - 1, 0)])

    for index, each in enumerate(task.states if len(begun) else ()):
        if each.wraps:
            up, down = begun[:, index].max() + each.turn * SHARES, begun[:, index].min() - each.turn * SHARES
            if each.turn < last(index, up) - last(index, down):
                turning[each.name] = each.turn / 2
    return turning


def _bounds_turns(condition: Failure, turning: Mapping[str, float]) -> bool:
    """Whether a condition bounds an angle, or its distance from something, beyond half a turn."""
    part = ast.parse(within_abs(condition.value)[0], mode="eval").body
    sides: list[ast.expr] = [part]
    if isinstance(part, ast.BinOp) and isinstance(part.op, ast.Add | ast.Sub):
        sides = [part.left, part.right]
    halves = [turning.get(each.id, np.inf) for each in sides if isinstance(each, ast.Name)]
    return any(abs(bound_of(condition)) > half for half in halves)


def _outside(text: str) -> set[str]:
    """The names that an expression uses outside of sin and cos."""
    found, parts = set[str](), list[ast.AST]([ast.parse(text.strip(), mode="eval").body])
    while parts:
        part = parts.pop()
        if isinstance(part, ast.Name):
            found.add(part.id)
        elif not (isinstance(part, ast.Call) and ast.unparse(part.func) in ("sin", "cos")):
            parts += ast.iter_child_nodes(part)
    return found
