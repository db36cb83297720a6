"""The goal of a declared task over time, as expressions or a file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simbias.core import Criterion, HardwareError, Quantity, StudyWarning, wrapped
from simbias.core.files import sought
from simbias.core.messages import quote
from simbias.core.records import Array
from simbias.core.table import read_table
from simbias.simulation.compiler import Expressions

TIME = "t"  # the name of time in expressions and of its column
MOST_ROWS = 400  # of a file: each row is an operation of the compiled loop
LONG = 100.0  # episodes: a longer file may have its time in ms
MANY_TURNS = 2  # a larger angle may be in degrees
SAMPLED = 10  # rows: a file with as many, evenly spaced by as many frames at most, is a sampled curve
MANY, SOME = 0.9, 0.1  # shares of drawn targets whose goals are refused, or told
BRIEF = 2  # frames, or rows of a sampled curve; the duration of a jump
JUMP = 0.1  # least share of the range, and
STEEP = 4.0  # least factor relative to the motion in as many frames before or after
ROUNDING = 1e-9  # smaller changes are no jumps


class Reference:
    """The reference of a goal's quantities: expressions of time t, or rows of a file, linearly interpolated.

    Expressions may use targets, whose means are given by name.

    ValueError if a file or an expression gives no finite number at a time from 0 to `seconds`.
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
    targets: Array,
) -> None:
    """Refuse a reference that violates a failure criterion, for one state or all, whatever the others.

    So does a reference for most of the drawn targets (k, .); for a tenth of them, a line says so.
    """
    times = np.linspace(0.0, seconds, 1000 if not len(targets) else 50)
    found = []
    for each in targets if len(targets) else (None,):
        values = np.broadcast_to(reference(times, each), (len(times), len(reference.names)))
        found += [*_violations(values, times, reference.names, states, criteria, measure)][:1]
    count = len(targets) or 1
    many = f" for {len(found)} of {count} drawn targets" if len(targets) else ""
    if len(found) > MANY * count:
        raise ValueError(f"{found[0]}{many}")
    if len(found) > SOME * count:
        warnings.warn(f"{found[0]}{many}", StudyWarning, stacklevel=4)


def _violations(
    values: Array,
    times: Array,
    names: Sequence[str],
    states: Sequence[str],
    criteria: Sequence[Criterion],
    measure: Callable[[Array], Array],
) -> Iterator[str]:
    """Where goal values (T, g) of states, each alone or all together, violate failure criteria, in words."""
    goals = {name: column for name, column in zip(names, values.T, strict=True) if name in states}
    together = [goals] if len(goals) > 1 else []
    for given in (*({name: column} for name, column in goals.items()), *together):
        x = np.column_stack([given.get(name, np.full(len(times), np.nan)) for name in states])
        for criterion, each in zip(criteria, measure(x).T, strict=True):
            if (beyond := each > criterion.limit).any():
                at = {name: f"{column[beyond][0]:.3g}" for name, column in given.items()}
                what = ", ".join(f"goal.{name} is {value}" for name, value in at.items())
                yield f"{what} at t = {times[beyond][0]:.3g} s, where the task fails: {criterion.name}"


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
    # By the path, not the change: a single row may jump there and back.
    jumps = np.argwhere((path > least) & (path > STEEP * beside)).tolist()
    sizes = np.maximum(moved, steps[:-1])
    return [(i, j, f"{sizes[i, j]:.3g} {goals[j].unit}".strip()) for i, j in jumps]
