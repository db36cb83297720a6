"""The trials of a sweep as input to its figures, and the contract of figures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from pandas import DataFrame

from simbias.pictures.elements.style import publish

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from simbias.sweep.batches import Batch, Outcomes
    from simbias.sweep.grid import Sweep
    from simbias.trial.run import TrialRecord

Row = Mapping[Any, Any]  # a row of a table of trials


NONE_ENDED = "no trial of the sweep ran to an end"
UNTESTED = (
    "no last policy was tested, and trials that have ended stay untested: "
    "run them with policy_test.episodes=20 tracking.trials=NEW_FOLDER"
)


class FigureError(RuntimeError):
    """A figure cannot be drawn from the available data."""


class UndrawnError(FigureError):
    """Figures of a sweep could not be drawn; its trials have ended, and its other figures are drawn."""

    def __init__(self, undrawn: Sequence[FigureError], trials: DataFrame, where: str) -> None:
        super().__init__("; ".join(map(str, undrawn)))
        self.undrawn, self.trials, self.where = undrawn, trials, where


@dataclass(frozen=True, eq=False)
class SweptTrials:
    """The trials of a sweep: as a table, and each as a full record."""

    sweep: Sweep
    table: DataFrame  # see `simbias.sweep.results`
    load: Callable[[str], TrialRecord]  # by hash

    @property
    def rows(self) -> list[Row]:
        """Rows of the trials that ended without an error, in the sweep's order.

        Raises
        ------
        FigureError
            If there is none.
        """
        rows: list[Row] = [row for row in self.table.to_dict("records") if row["outcome"] != "error"]
        if not rows:
            raise FigureError(NONE_ENDED)
        return rows

    def in_full(self) -> Iterator[tuple[Row, TrialRecord]]:
        """The trials of `rows` in full, read back one by one, each with its row.

        Raises
        ------
        FigureError
            If there is none, or one has no iteration because its budget allowed none.
        """
        for row in self.rows:
            trial = self.load(row["hash"])
            if not trial.iterations:
                raise FigureError(f"trial {row['hash']} ended before an iteration did (budget)")
            yield row, trial

    def labels(self, row: Row) -> tuple[str, ...]:
        """The labels of a trial's cell, one for each axis."""
        return tuple(row[axis.name] for axis in self.sweep.axes)

    def cell(self, row: Row) -> str:
        """The cell of a trial, in words."""
        return self.sweep.words(self.labels(row))


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure of a sweep."""

    figure: Figure
    numbers: DataFrame  # all numbers that it shows, or their sums
    caption: str
    animate: Callable[[Path], object] | None = None  # writes a GIF

    def write(self, folder: Path, name: str) -> list[Path]:
        """Write name.png, .svg, .pdf, .csv, .md (the caption) and, if animated, .gif; return their paths."""
        csv, md = folder / f"{name}.csv", folder / f"{name}.md"
        paths = [*publish(self.figure, folder, name), csv, md]
        self.numbers.to_csv(csv, index=False, float_format="%.6g")
        md.write_text(fill(self.caption, 110) + "\n", encoding="utf-8")
        if self.animate is not None:
            paths.append(folder / f"{name}.gif")
            self.animate(paths[-1])
        return paths


class SweepFigure(ABC):
    """A figure of a sweep, drawn once all trials have ended."""

    reads_trials = True  # whether it reads full records from folders; else only the table
    reads_tests = False  # whether it uses tests of last policies

    def experiments(self, trials: SweptTrials) -> Sequence[Batch]:
        """Hardware experiments needed in addition to those of the trials; by default none."""
        return ()

    @abstractmethod
    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture, from the trials and the outcomes of the experiments.

        Raises
        ------
        FigureError
            If it cannot be drawn from the available data.
        """
