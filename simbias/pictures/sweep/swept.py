"""The trials of a sweep, for its figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pandas import DataFrame

if TYPE_CHECKING:
    from simbias.sweep.grid import Sweep
    from simbias.tracking.trials import RecordedTrial


Row = Mapping[Any, Any]  # of a table of trials


class FigureError(RuntimeError):
    """A figure cannot be drawn from what there is."""


@dataclass(frozen=True, eq=False)
class SweptTrials:
    """What a sweep found: a table of its trials, and each trial in full."""

    sweep: Sweep
    table: DataFrame  # as `simbias.tracking.results` describes it
    load: Callable[[str], RecordedTrial]  # of a run_id

    @property
    def rows(self) -> list[Row]:
        """Rows of the trials that ran to an end, in the sweep's order.

        Raises
        ------
        FigureError
            If there is none.
        """
        rows: list[Row] = [row for row in self.table.to_dict("records") if row["outcome"] != "error"]
        if not rows:
            raise FigureError("no trial of the sweep ran to an end")
        return rows

    def recorded(self) -> Iterator[tuple[Row, RecordedTrial]]:
        """The same trials in full, read back one by one, with their rows."""
        for row in self.rows:
            yield row, self.load(row["run_id"])

    def cell(self, row: Row) -> str:
        """The cell of a trial, by its labels."""
        return " ".join(row[axis.name] for axis in self.sweep.axes)
