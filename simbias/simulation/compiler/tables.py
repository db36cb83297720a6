"""Tables that a policy looks up by time, such as a trajectory and the gains along it.

In a trace, looking up a column is one operation, regardless of its number of rows. The compiled loop reads
the two rows around a lane's time before each frame, like noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from simbias.core.records import Array
from simbias.simulation.compiler.symbolic_arrays import array
from simbias.simulation.compiler.symbols import LOOKED_UP, Symbol, TraceError


def scheduled(table: Array, t: Any, spacing: float) -> Array:
    """The row (..., c) at time t of a table (..., K, c), interpolated between rows at every `spacing` s.

    There are at least two rows. The first one is for t = 0; the last one applies from its time on. The trace
    of a policy may look up one table, and only by the time itself.
    """
    if isinstance(t, Symbol):
        return _written_down(table, t, spacing)
    last = table.shape[-2] - 1
    position = min(t / spacing, float(last))
    row = min(int(position), last - 1)
    before, after = table[..., row, :], table[..., row + 1, :]
    return before + (position - row) * (after - before)


def _written_down(table: Any, t: Symbol, spacing: float) -> Any:
    """A symbol for each column: an operation on the time, the spacing and all entries of the column."""
    if t.value != "t":
        raise TraceError("a table is looked up by another value than the time")
    trace, entries = t.trace, np.asarray(table).reshape(-1, *np.shape(table)[-2:])
    if len(entries) != 1:
        raise TraceError("for one row it looks up several tables")
    columns = [
        [each if isinstance(each, Symbol) else trace.entry(each) for each in one] for one in entries[0].T
    ]
    shared = t, trace.entry(spacing)
    row = array([trace.operation(LOOKED_UP, *shared, *column) for column in columns])
    return row.reshape(*np.shape(table)[:-2], len(columns))


class Lookup(NamedTuple):
    """Columns of one table that a trace looks up."""

    columns: list[Symbol]  # c
    table: list[Symbol]  # (1 + K c): the spacing, then the entries, row by row

    @staticmethod
    def among(symbols: Sequence[Symbol]) -> Lookup:
        """The looked-up columns among these symbols; if there are none, an empty lookup."""
        columns = [symbol for symbol in symbols if symbol.name == LOOKED_UP]
        if len({(symbol.operands[1].value, len(symbol.operands)) for symbol in columns}) > 1:
            raise TraceError("it looks up several tables, at other times")
        rows = zip(*(symbol.operands[2:] for symbol in columns), strict=True)
        entries = [entry for row in rows for entry in row]
        return Lookup(columns, [columns[0].operands[1], *entries] if columns else [])
