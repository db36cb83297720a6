"""Trajectories that come back from a lab: brought to the task's frames, or refused in one line."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simbias.core import HardwareError, Quantity, Task
from simbias.core.messages import quote, words
from simbias.core.records import Array, Rollout

TIME, FAILURE = Quantity("time", "s"), "failure"  # columns beside states and inputs
JITTER = 0.25  # of a frame, within which a row counts as on time
GAP = 2.5  # intervals between rows that are no gap yet
COARSEST = 1.05  # of the task's time step that the rows may be apart


@dataclass(frozen=True, eq=False)
class Recording:
    """What a lab recorded, a row for each time."""

    times: Array  # (r,) s
    states: Array  # (r, n) measured
    inputs: Array  # (r, m) commanded from this time on
    failure: str | None = None  # that the lab tells of, in the last row
    rows: tuple[int, ...] = ()  # where in the file they stand, the header being row 1


def header(task: Task) -> list[str]:
    """The columns of a file: names with units."""
    columns = (TIME, *task.states, *task.inputs)
    return [*(f"{quantity.name} ({quantity.unit})" for quantity in columns), FAILURE]


def template(task: Task, start: Array) -> str:
    """A file with its header and the row of the start, for a person to fill."""
    first = ["0.0", *(repr(float(value)) for value in start), *("" for _ in task.inputs), ""]
    return f"{','.join(header(task))}\n{','.join(first)}\n"


def read(path: Path, task: Task) -> Rollout:
    """The rollout in a file.

    Raises
    ------
    HardwareError
        If something is wrong with it: one line with file, row and column.
    """
    return frame(_read(path, task), task, str(path))


def _read(path: Path, task: Task) -> Recording:
    """What stands in a file."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise HardwareError(f"{path}: cannot be read ({words(error)})") from error
    try:
        lines = [(number, row) for number, row in enumerate(csv.reader(io.StringIO(text)), 1) if any(row)]
    except csv.Error as error:
        raise HardwareError(f"{path}: is no CSV ({words(error)})") from error
    if len(lines) < 2:
        raise HardwareError(f"{path}: expected a header and rows, got {len(lines)} lines")
    columns, failure_column = _columns(path, [cell.strip() for cell in lines[0][1]], task)
    rows = lines[1:]
    table = np.empty((len(rows), len(columns)))
    last_inputs = range(1 + len(task.states), len(columns))
    for index, (number, row) in enumerate(rows):
        if len(row) < len(lines[0][1]):
            row = [*row, *[""] * (len(lines[0][1]) - len(row))]
        for place, (column, name) in enumerate(columns):
            cell = row[column].strip()
            blank = not cell and index == len(rows) - 1 and place in last_inputs  # nothing acted any more
            table[index, place] = 0.0 if blank else _number(cell, f"{path}: row {number}, column {name}")
    failure = "" if failure_column is None else [*rows[-1][1], ""][failure_column : failure_column + 1]
    n = len(task.states)
    return Recording(
        table[:, 0],
        table[:, 1 : 1 + n],
        table[:, 1 + n :],
        "".join(failure).strip() or None,
        tuple(number for number, _ in rows),
    )


def _columns(path: Path, names: Sequence[str], task: Task) -> tuple[list[tuple[int, str]], int | None]:
    """Where each quantity's column is, and that of the failure; others may stand between them."""
    found = []
    for quantity in (TIME, *task.states, *task.inputs):
        bare = [name.partition("(")[0].strip() for name in names]
        if bare.count(quantity.name) != 1:
            several = "several" if quantity.name in bare else "none"
            raise HardwareError(
                f"{path}: row 1: expected a column {quantity.name} ({quantity.unit}), got {several} among "
                f"{quote(', '.join(names))}"
            )
        column = bare.index(quantity.name)
        unit = names[column].partition("(")[2].removesuffix(")").strip()
        if unit != quantity.unit:
            raise HardwareError(
                f"{path}: row 1, column {quantity.name}: expected the unit ({quantity.unit}), "
                f"got {quote(unit)}; convert the values"
            )
        found.append((column, quantity.name))
    return found, names.index(FAILURE) if FAILURE in names else None


def _number(cell: str, where: str) -> float:
    """A finite number."""
    try:
        value = float(cell)
    except ValueError:
        raise HardwareError(f"{where}: expected a number, got {quote(cell)}") from None
    if not math.isfinite(value):
        raise HardwareError(f"{where}: expected a finite number, got {quote(cell)}")
    return value


def frame(recording: Recording, task: Task, source: str) -> Rollout:
    """A recording at the task's frames, up to its first failure.

    Rows that are more frequent are resampled: states between rows lie on straight lines, an input is the
    mean of those that acted during the frame. Rows that are rarer, and gaps, are refused.

    Raises
    ------
    HardwareError
        In one line that begins with the source and names row and column.
    """
    rows = recording.rows or tuple(range(1, len(recording.times) + 1))
    times = recording.times - recording.times[0]
    _check_times(times, rows, task, source)
    _check_inputs(recording.inputs, rows, task, source)
    frames = np.arange(math.floor(times[-1] / task.time_step + JITTER) + 1)[: task.horizon + 1]
    wanted = frames * task.time_step
    if len(times) >= len(frames) and np.all(np.abs(times[: len(frames)] - wanted) <= JITTER * task.time_step):
        states, inputs = recording.states[: len(frames)], recording.inputs[: len(frames) - 1]
    else:
        states = np.stack([np.interp(wanted, times, column) for column in recording.states.T], axis=1)
        inputs = _means(times, recording.inputs, wanted)
    return _ended(states, inputs, recording.failure, task, f"{source}: row {rows[-1]}")


def _check_times(times: Array, rows: Sequence[int], task: Task, source: str) -> None:
    """Refuse times that do not go on steadily and often enough."""
    steps = np.diff(times)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        row = rows[back[0] + 1]
        raise HardwareError(
            f"{source}: row {row}, column time: expected more than {times[back[0]]:g} s, as in the row "
            f"before, got {times[back[0] + 1]:g} s (since the first row)"
        )
    if not len(steps):
        return
    usual = float(np.median(steps))
    if usual > COARSEST * task.time_step:
        raise HardwareError(
            f"{source}: column time: expected a row at least every {task.time_step:g} s "
            f"({1 / task.time_step:g} Hz), got one every {usual:g} s ({1 / usual:.4g} Hz)"
        )
    gaps = np.flatnonzero(steps > GAP * max(usual, task.time_step))
    if len(gaps):
        raise HardwareError(
            f"{source}: row {rows[gaps[0] + 1]}, column time: expected no gap, got one of "
            f"{steps[gaps[0]]:g} s after {times[gaps[0]]:g} s"
        )


def _check_inputs(inputs: Array, rows: Sequence[int], task: Task, source: str) -> None:
    """Refuse inputs that no policy gave: they are in another unit."""
    beyond = np.argwhere(np.abs(inputs) > task.input_limit * (1 + 1e-6))
    if len(beyond):
        row, column = beyond[0]
        quantity = task.inputs[column]
        raise HardwareError(
            f"{source}: row {rows[row]}, column {quantity.name}: expected at most "
            f"{task.input_limit[column]:g} {quantity.unit}, got {inputs[row, column]:g}"
        )


def _means(times: Array, inputs: Array, wanted: Array) -> Array:
    """The means (k, m) of inputs that are held between times, from each wanted time to the next."""
    steps = np.diff(times)[:, None]
    sums = np.concatenate([np.zeros((1, inputs.shape[1])), np.cumsum(steps * inputs[:-1], axis=0)])
    at = np.stack([np.interp(wanted, times, column) for column in sums.T], axis=1)
    return np.diff(at, axis=0) / np.diff(wanted)[:, None]


def _ended(states: Array, inputs: Array, failure: str | None, task: Task, end: str) -> Rollout:
    """The rollout up to the first state that failed, or the failure that the lab tells of."""
    violated = np.flatnonzero(task.violated(states) >= 0)
    k = int(violated[0]) if len(violated) else len(inputs)
    if len(violated):
        failure = task.failure(states[k])
    if failure is None and k < task.horizon:
        raise HardwareError(
            f"{end}: expected {task.horizon} frames of {task.time_step:g} s, the recording ends after {k} "
            f"without a failure; if the robot failed, name how in the last row's column {FAILURE}"
        )
    states, inputs = states[: k + 1], inputs[:k]
    return Rollout(states, inputs, None if failure is None else k, failure, measured=states, sensed=True)
