"""Files with trajectories from a lab."""

from __future__ import annotations

from pathlib import Path

from simbias.core import HardwareError, Quantity, Task
from simbias.core.messages import quote
from simbias.core.records import Array, Rollout
from simbias.core.table import POINT, Table, read_table
from simbias.lab.requests.measurements import FAILURE, Measurements, frame
from simbias.lab.requests.request import ExperimentRequest

TIME = Quantity("time", "s")  # a column beside states and inputs
NO_FAILURE = {"", "-", "none", "nan", "na", "n/a", "null", "no", "ok"}  # how tools denote no failure


def header(task: Task) -> list[str]:
    """The columns of a file: names with units."""
    columns = (TIME, *task.states, *task.inputs)
    return [*(f"{quantity.name} ({quantity.unit})" for quantity in columns), FAILURE]


def template(task: Task, start: Array) -> str:
    """A file with its header and the start's row, for a person to fill in."""
    first = ["0.0", *(repr(float(value)) for value in start), *("" for _ in task.inputs), ""]
    return f"{','.join(header(task))}\n{','.join(first)}\n"


def read(path: Path, request: ExperimentRequest) -> Rollout:
    """The rollout in a file that answers a request.

    Raises
    ------
    HardwareError
        If the file is wrong; the message gives file, row and column in one line.
    """
    table = read_table(path, may_lack=FAILURE)
    columns = _columns(table, request.task)
    n = len(request.task.states)
    numbers = table.numbers(columns, may_be_blank=columns[1 + n :])  # no input acts after the last
    measurements = Measurements(
        numbers[:, 0], numbers[:, 1 : 1 + n], numbers[:, 1 + n :], _failure(table), table.rows
    )
    return frame(measurements, request, str(path))


def _columns(table: Table, task: Task) -> list[int]:
    """Indices of the columns of time, states and inputs; other columns may lie between them."""
    bare, found = [name.partition("(")[0].strip() for name in table.names], []
    for name, unit, *_ in (TIME, *task.states, *task.inputs):
        if bare.count(name) != 1:
            raise HardwareError(
                f"{table.source}: row 1: expected a column {name} ({unit}), got "
                f"{'several' if name in bare else 'none'} among {quote(', '.join(table.names))}"
            )
        column = bare.index(name)
        given = table.names[column].partition("(")[2].removesuffix(")").strip()
        if given != unit:
            raise HardwareError(
                f"{table.source}: row 1, column {name}: expected the unit ({unit}), got {quote(given)}; "
                f"convert the values"
            )
        found.append(column)
    return found


def _failure(table: Table) -> str | None:
    """The failure named in the last row, and in no other."""
    if FAILURE not in table.names:
        return None
    column, last, named = table.names.index(FAILURE), len(table.rows) - 1, ""
    for index, cells in enumerate(table.cells):
        cell = cells[column].strip()
        if POINT.fullmatch(cell):
            raise table.error(
                index, column, f"expected a name, got {quote(cell)}; has a decimal comma cut a number in two?"
            )
        named = "" if cell.lower() in NO_FAILURE else cell
        if named and index < last:
            raise table.error(index, column, f"expected it only in the last row, got {quote(cell)}")
    return named or None
