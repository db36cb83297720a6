"""The goal of a declared task, and its success conditions."""

from __future__ import annotations

import ast
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simbias.core import Criterion, HardwareError, Quantity, StudyWarning, wrapped
from simbias.core.files import sought
from simbias.core.messages import quote
from simbias.core.records import Array
from simbias.core.table import read_table
from simbias.robots.declared.declarations import Failure, criterion_of
from simbias.simulation.compiler import Expressions

TIME = "t"  # the name of time in expressions and of its column
MOST_ROWS = 400  # of a file: each row is an operation of the compiled loop
LONG = 100.0  # episodes: a longer file may have its time in ms
MANY_TURNS = 2  # a larger angle may be in degrees
SAMPLED = 10  # rows: a file with as many, evenly spaced by as many frames at most, is a sampled curve
BRIEF = 2  # frames, or rows of a sampled curve; the duration of a jump
JUMP = 0.1  # least share of the range, and
STEEP = 4.0  # least factor relative to the motion in as many frames before or after
ROUNDING = 1e-9  # smaller changes are no jumps


class Reference:
    """The reference of a goal's quantities: expressions of time t, or rows of a file, linearly interpolated.

    Expressions may use targets, whose means are given by name.

    Raises
    ------
    ValueError
        If a file or an expression gives no finite number at a time from 0 to `seconds`.
    """

    def __init__(
        self,
        expressions: Mapping[str, str],
        file: str | None,
        constants: Mapping[str, float],
        seconds: float,
        targets: Mapping[str, float],
    ) -> None:
        self._means = np.array(list(targets.values()))  # (k,)
        if file is None:
            self.names = tuple(expressions)
            named = {f"goal.{name}": text for name, text in expressions.items()}
            self._expressions: Expressions | None = Expressions(named, (TIME, *targets), constants)
            self.end, self.rows = seconds, np.zeros(0)  # s, and times (k,) of a file's rows
        else:
            self._expressions = None
            self.names, self._times, values = _rows(file, seconds)
            self.rows = self._times
            self.end = min(self._times[-1], LONG * seconds)
            slopes = np.diff(values, axis=0) / np.diff(self._times)[:, None]
            self._first, self._changes = values[0], np.diff(slopes, axis=0, prepend=0.0, append=0.0)
        times = np.linspace(0.0, seconds, 1000)
        finite = np.broadcast_to(np.isfinite(self(times)), (len(times), len(self.names)))
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            raise ValueError(f"goal.{self.names[column]} is not a finite number at t = {times[row]:.3g} s")

    def __call__(self, t: Any, targets: Array | None = None) -> Array:
        """Reference values (..., g) at times t (...) in s, for targets (..., k); None: their means."""
        times = np.stack([t], axis=-1)  # (..., 1); a number may be a symbol
        if self._expressions is not None:
            if len(self._means):
                given = self._means if targets is None else targets
                each = [given[..., index] for index in range(len(self._means))]
                times = np.stack([t + 0.0 * each[0], *(value + 0.0 * t for value in each)], axis=-1)
            values = self._expressions(times[None])
            return values[0] if values.ndim > times.ndim else values  # if all are constants, there is one row
        return self._first + np.maximum(times - self._times, 0.0) @ self._changes


def _rows(file: str, seconds: float) -> tuple[tuple[str, ...], Array, Array]:
    """The names (g), times (k,) and values (k, g) in a reference's file."""
    try:
        table = read_table(Path(file))
        header, numbers = table.names, table.numbers(range(len(table.names)))
    except HardwareError as error:
        where = sought(file) if isinstance(error.__cause__, FileNotFoundError) else ""
        raise ValueError(f"reference {error}{where}") from error
    if header[0] != TIME or len(header) < 2 or len(set(header)) < len(header):
        raise ValueError(
            f"reference {quote(file)}: expected rows of t and of the goal's quantities, "
            f"got the columns {quote(','.join(header))}"
        )
    times, values = numbers[:, 0], numbers[:, 1:]
    if len(times) > MOST_ROWS:
        raise ValueError(
            f"reference {quote(file)}: expected at most {MOST_ROWS} rows, with lines between them, "
            f"got {len(times)}"
        )
    if times[0] > 0 or (np.diff(times) <= 0).any():
        raise ValueError(f"reference {quote(file)}: t must increase from 0")
    if times[-1] < seconds - 1e-9:
        raise ValueError(f"reference {quote(file)} ends at {times[-1]:g} s, an episode at {seconds:g} s")
    if times[-1] > LONG * seconds:
        warnings.warn(
            f"reference {quote(file)} lasts {times[-1]:g} s, but an episode takes {seconds:g} s: "
            "is its t in ms?",
            StudyWarning,
            stacklevel=4,
        )
    return header[1:], times, values


def check_within(
    reference: Reference,
    states: Sequence[str],
    criteria: Sequence[Criterion],
    measure: Callable[[Array], Array],
    seconds: float,
) -> None:
    """Refuse a reference for a state that alone violates a failure criterion, whatever the other states."""
    times = np.linspace(0.0, seconds, 1000)
    values = np.broadcast_to(reference(times), (len(times), len(reference.names)))
    for column, name in zip(values.T, reference.names, strict=True):
        x = np.where(np.array(states) == name, column[:, None], np.nan)
        for criterion, each in zip(criteria, measure(x).T, strict=True):
            if (beyond := each > criterion.limit).any():
                raise ValueError(
                    f"goal.{name} is {column[beyond][0]:.3g} at t = {times[beyond][0]:.3g} s, "
                    f"where the task fails: {criterion.name}"
                )


def warn_of_degrees(reference: Reference, goals: Sequence[Quantity], seconds: float) -> None:
    """Warn of a wrapping angle in rad whose goal is turns away from zero, but does not keep turning."""
    times = np.linspace(0.0, seconds, 1000)
    values = np.broadcast_to(reference(times), (len(times), len(goals)))
    for goal, each in zip(goals, values.T, strict=True):
        steps, value = np.diff(each), np.abs(each).max()
        turns_on = abs(each[0]) <= goal.turn and ((steps > 0).all() or (steps < 0).all())
        if goal.wraps and goal.unit == "rad" and value > MANY_TURNS * goal.turn and not turns_on:
            words = f"goal.{goal.name} is {value:.4g} rad, more than {MANY_TURNS} turns: is it in degrees?"
            warnings.warn(words, StudyWarning, stacklevel=4)


def warn_of_turns(
    where: Mapping[str, str], conditions: Mapping[str, Failure], turning: Mapping[str, float]
) -> None:
    """Warn if a condition uses an angle that wraps outside of sin and cos, where its turns count.

    Conditions are named by their keys; `where` holds expressions that they may use, and `turning` half a turn
    of each angle that may make one. A bound beyond half a turn on an angle is meant to count turns.
    """
    angles = {name: name for name in turning}
    for key, text in (*where.items(), *((key, each.value) for key, each in conditions.items())):
        for name in sorted(angles.keys() & _outside(text)):
            angles[key] = angles[name]
    meant = {key for key, each in conditions.items() if _bounds_turns(each, turning)}
    for key in [key for key in conditions if key in angles.keys() - meant][:1]:
        angle = angles[key]
        words = f"{key} uses {angle}, which wraps, with its turns, so that a whole turn is not zero; "
        words += f"sin({angle}), cos({angle}) and the goal's error leave them out"
        warnings.warn(words, StudyWarning, stacklevel=4)


def _bounds_turns(condition: Failure, turning: Mapping[str, float]) -> bool:
    """Whether a condition bounds an angle, or its distance from something, beyond half a turn."""
    part = ast.parse(_within(condition.value)[0], mode="eval").body
    sides: list[ast.expr] = [part]
    if isinstance(part, ast.BinOp) and isinstance(part.op, ast.Add | ast.Sub):
        sides = [part.left, part.right]
    halves = [turning.get(each.id, np.inf) for each in sides if isinstance(each, ast.Name)]
    return any(abs(_bound(condition)) > half for half in halves)


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


def check_jumps(reference: Reference, goals: Sequence[Quantity], time_step: float) -> None:
    """Refuse a reference with jumps, which no robot can follow."""
    times = time_step * np.arange(round(reference.end / time_step) + 1, dtype=np.float64)
    for frame, column, change in _jumps(reference, goals, times)[:1]:
        raise ValueError(
            f"goal.{goals[column].name} jumps after t = {times[frame]:.4g} s: by {change} in {BRIEF} frames; "
            "use a ramp, which can be followed"
        )


def check_rows(reference: Reference, goals: Sequence[Quantity], file: str, time_step: float) -> None:
    """Refuse rows between which an angle that wraps jumps, and warn of a step between sampled rows."""
    rows, turns = reference.rows, np.array([goal.turn for goal in goals])
    values, half = reference(rows), np.where(turns, 0.501 * turns, np.inf)
    for row, column in np.argwhere(np.abs(np.diff(values, axis=0)) > half)[:1]:
        before, after = values[row : row + 2, column]
        near = after - turns[column] * np.round((after - before) / turns[column])
        raise ValueError(
            f"reference {quote(file)}, row of t = {rows[row + 1]:.4g} s, column {goals[column].name}: "
            f"{after:.4g} is more than half a turn from {before:.4g}; write {near:.4g}, or add rows between"
        )
    spacing = rows[1] - rows[0]
    if len(rows) < SAMPLED or np.ptp(np.diff(rows)) > 0.01 * spacing or spacing > 1.01 * SAMPLED * time_step:
        return
    for row, column, change in _jumps(reference, goals, rows)[:1]:
        words = f"within {BRIEF} rows of {quote(file)}, after t = {rows[row]:.4g} s: is it a step?"
        words = f"goal.{goals[column].name} changes by {change} {words} A ramp can be followed"
        warnings.warn(words, StudyWarning, stacklevel=4)


def _jumps(reference: Reference, goals: Sequence[Quantity], times: Array) -> list[tuple[int, int, str]]:
    """The times after which goal quantities jump, by their indices, and by how much, in words."""
    values = np.broadcast_to(reference(times), (len(times), len(goals)))
    steps = np.abs(wrapped(np.diff(values, axis=0), goals))
    moved = np.abs(wrapped(values[BRIEF:] - values[:-BRIEF], goals))
    path = steps[1:] + steps[:-1]  # in BRIEF frames, in both directions: a fast sine moves at extremes
    around = np.pad(path, ((BRIEF, BRIEF), (0, 0)))
    beside = np.maximum(around[: -2 * BRIEF], around[2 * BRIEF :])
    least = np.maximum(JUMP * np.ptp(values, axis=0), ROUNDING)
    jumps = np.argwhere((moved > least) & (moved > STEEP * beside)).tolist()
    return [(i, j, f"{moved[i, j]:.3g} {goals[j].unit}".strip()) for i, j in jumps]


class Success:
    """Success conditions that must hold for the last seconds of an episode.

    Besides states, expressions may use time t and `<name>_error` of each goal quantity.
    """

    def __init__(
        self, conditions: Mapping[str, Failure], measures: Expressions, frames: int, seconds: float
    ) -> None:
        self._conditions = conditions
        limits = [criterion_of(name, each, ()).limit for name, each in conditions.items()]
        self._limits = np.array(limits)  # which the measures must exceed
        self._measures = measures
        self._frames, self._seconds = frames, seconds

    def check_at(self, goal: Array) -> None:
        """Refuse conditions on errors and time alone that do not hold at zero error.

        The rows (k, .) have the times of the last frames and zero errors; states, which the goal may not
        determine, are nan.
        """
        least = self._measures(goal).min(axis=0)
        for (name, each), value, limit in zip(self._conditions.items(), least, self._limits, strict=True):
            if value <= limit:
                there = f"{each.value} is {_beside_bound(each, value, limit)} at the goal"
                raise ValueError(f"success.{name} cannot hold: {there}")

    def check_beside(self, failures: Mapping[str, Failure]) -> None:
        """Refuse conditions on an expression or its `abs` that contradict each other or failure criteria."""
        own = {f"success.{name}": each for name, each in self._conditions.items()}
        keyed = own | {f"failure.{name}": each for name, each in failures.items()}
        together = defaultdict[str, list[str]](list)
        for key, each in keyed.items():
            together[_within(each.value)[0]].append(key)
        for expression, keys in together.items():
            ends = np.unique([(0.0, _bound(keyed[key]), -_bound(keyed[key])) for key in keys])
            values = np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, 2 * ends[[0, -1]] + [-1.0, 1.0]])
            met = [(_margin(keyed[key], values) > 0) == (key in own) for key in keys]
            if keys[0] in own and not np.all(met, axis=0).any():
                kept, avoided = ([key for key in keys if (key in own) == is_own] for is_own in (True, False))
                words = " and ".join(kept) + (" without " + " or ".join(avoided)) * bool(avoided)
                raise ValueError(f"success cannot hold: no value of {expression} meets {words}")

    def check_numbers(self, states: Array, times: Array, errors: Array) -> None:
        """Refuse conditions that are not a number in any of these states (k, .)."""
        measures = self._measures(_rows_of(states, times, errors))
        for name, each in zip(self._conditions, measures.T, strict=True):
            if np.isnan(each).all():
                raise ValueError(f"success.{name} is not a number in any of {len(states)} states")

    def holds(self, states: Array, times: Array, errors: Array) -> bool:
        """Whether an episode of states (T+1, .) at times (T+1,), with errors (T+1, g), succeeds."""
        return bool((self._least(states, times, errors) > self._limits).all())

    def share(self, states: Array, times: Array, errors: Array) -> float:
        """The share of an episode's frames in which all conditions hold."""
        return float((self._measures(_rows_of(states, times, errors)) > self._limits).all(axis=1).mean())

    def shortfalls(self, states: Array, times: Array, errors: Array) -> Array:
        """How far (T+1, k) each frame is from the limits of the conditions that an episode misses."""
        short = np.maximum(self._limits - self._measures(_rows_of(states, times, errors)), 0.0)
        return short[:, ~(self._least(states, times, errors) > self._limits)]

    def missed(self, states: Array, times: Array, errors: Array) -> str:
        """The conditions that do not hold, each with the value furthest from its bound."""
        least = self._least(states, times, errors)
        missed = []
        for (name, each), value, limit in zip(self._conditions.items(), least, self._limits, strict=True):
            if not value > limit:
                missed.append(f"{name} is {_beside_bound(each, value, limit)}")
        return f"in its last {self._seconds:g} s {'; '.join(missed)}"

    def _least(self, states: Array, times: Array, errors: Array) -> Array:
        """The least of each measure in the last frames."""
        least: Array = self._measures(_rows_of(states, times, errors)[-self._frames :]).min(axis=0)
        return least


def _within(expression: str) -> tuple[str, bool]:
    """An expression in one spelling, without an outer `abs`, and whether it has one."""
    node = ast.parse(expression.strip(), mode="eval").body
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "abs":
        return ast.unparse(node.args[0]), True
    return ast.unparse(node), False


def _bound(condition: Failure) -> float:
    """The number that a condition's value is compared with."""
    return criterion_of("", condition, ()).limit * (1.0 if condition.below is None else -1.0)


def _margin(condition: Failure, values: Array) -> Array:
    """By how much (k,) the expression of a condition, or that within its `abs`, meets it at these values."""
    given = np.abs(values) if _within(condition.value)[1] else values
    return (given - _bound(condition)) * (1.0 if condition.below is None else -1.0)


def _rows_of(states: Array, times: Array, errors: Array) -> Array:
    """The variables (T+1, .) of success expressions, frame by frame."""
    return np.concatenate([states, times[:, None], errors], axis=1)


def _beside_bound(condition: Failure, measure: float, limit: float) -> str:
    """A measure and the limit that it does not exceed, in the words of the condition."""
    side, sign = ("above", 1) if condition.below is None else ("below", -1)
    value = f"{sign * measure + 0.0:.3g} {condition.unit}".strip()
    return f"{value}, not {side} {sign * limit:g}"


def success_names(states: Sequence[str], goals: Sequence[Quantity]) -> list[str]:
    """The variables of success expressions, in the order of `Success.holds`."""
    return [*states, TIME, *(f"{goal.name}_error" for goal in goals)]
