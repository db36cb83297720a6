"""Table II as a figure: experiments along an axis, with their intervals, and the paper's."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from simbias.core.proportions import CONFIDENCE
from simbias.core.ranges import FigureWidth
from simbias.pictures.elements.layout import PAGE, fitting, legend, letters
from simbias.pictures.elements.style import literal, plain, series_style
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import NONE_ENDED, FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.statistics import FEWEST
from simbias.sweep.tables import cells, failures

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from simbias.sweep.grid import Sweep

REST = 0.8  # in, height without the rows
ROW, CURVE, LINE = 0.3, 0.16, 0.17  # in: minimum per point, per curve, per line of its label
CHARACTERS = 40  # per line of a label, across the page
PAPER_BELOW = 0.06  # in, offset of the paper's mean below ours


class Experiments(SweepFigure):
    """Table II: mean number of experiments in each cell, along the first axis that is not in columns.

    A row for each point of that axis. Bars are bootstrap intervals, hollow markers the paper's means; if not
    every trial succeeded, a fraction shows how many did, and how many raised an error.
    """

    reads_trials = False

    def __init__(self, width: FigureWidth = PAGE) -> None:
        self._width = width

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are the table of `simbias.sweep.tables.cells`."""
        if not trials.sweep.axes:
            raise FigureError("the sweep has no axis along which to draw its cells")
        table = cells(trials.table, trials.sweep)
        if not table["trials"].any():
            raise FigureError(NONE_ENDED)
        return Picture(
            _figure(table, trials.sweep, self._width), table, _caption(table, failures(trials.table))
        )


def _caption(table: pd.DataFrame, failing: str) -> str:
    """The caption, from the numbers."""
    trials, successes = table["trials"].sum(), table["succeeded"].sum()
    papers = "; hollow: the paper's means" if table["paper"].notna().any() else ""
    fewer, paper = (table["mean"] < table["paper"]).sum(), table["paper"].notna().sum()
    against = f" In {fewer} of {paper} cells the mean is below the paper's." if paper else ""
    return (
        f"Mean number of hardware experiments until success, with {CONFIDENCE:.0%} bootstrap intervals "
        f"(of {FEWEST} trials at least, not all equal){papers}. {successes} of {trials} trials succeeded "
        "(beside cells: of their own, if not all, and how many raised an error); "
        f"one that did not counts all that it may make{failing}."
        f"{against}"
    )


def _figure(table: pd.DataFrame, sweep: Sweep, width: float) -> Figure:
    """The points of an axis, a curve for each combination of the others."""
    from matplotlib.figure import Figure  # lazily: a sweep is announced before drawing is needed

    along = next((axis for axis in sweep.axes if axis.name != sweep.report.columns), sweep.axes[0])
    others = [axis for axis in sweep.axes if axis is not along]
    curves = list(itertools.product(*(axis.labels for axis in others)))
    texts = [literal(", ".join(point.texts)) for point in along.points]
    labels = [fill(text, fitting(CHARACTERS, width)) for text in texts]
    row = max(ROW, CURVE * (1 + len(curves)), LINE * (1 + max(label.count("\n") for label in labels)))
    figure = Figure(figsize=(width, row * len(labels) + REST), layout="constrained")
    axes = figure.add_subplot()
    for index, point in enumerate(curves):
        own = table
        for axis, label in zip(others, point, strict=True):
            own = own[own[axis.name] == label]
        offset = CURVE / row * (index - (len(curves) - 1) / 2)
        _curve(axes, own, offset, PAPER_BELOW / row, index, literal(", ".join(point)))
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    size = letters(width)
    axes.tick_params(labelsize=size)
    axes.set_ylabel(", ".join(along.heads), fontsize=size)
    axes.set_xlim(left=0)
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel(fill("hardware experiments until success", fitting(CHARACTERS, width)), fontsize=size)
    plain(axes, "x")
    if len(curves) > 1 or bool(table["paper"].notna().any()):
        legend(figure, _ours_first(axes), literal(", ".join("/".join(axis.heads) for axis in others)))
    return figure


def _ours_first(axes: Axes) -> dict[str, Artist]:
    """The entries of a legend, the paper's last."""
    handles, labels = axes.get_legend_handles_labels()
    entries = zip(labels, handles, strict=True)
    return dict(sorted(entries, key=lambda entry: entry[0].endswith("paper")))


def _curve(axes: Axes, own: pd.DataFrame, offset: float, below: float, index: int, name: str) -> None:
    """The cells of one curve, offset so that no interval hides another."""
    y = np.arange(len(own)) + offset
    mean, low, high = (own[column].to_numpy(dtype=float) for column in ("mean", "low", "high"))
    color, marker = series_style(index)
    style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 5, "linestyle": ""}
    spread = np.nan_to_num(np.clip([mean - low, high - mean], 0, None))
    axes.errorbar(mean, y, xerr=spread, capsize=2, label=name or "ours", **style)
    paper = own["paper"].to_numpy(dtype=float)
    if not np.isnan(paper).all():
        label = f"{name}, paper" if name else "paper"
        axes.plot(paper, y + below, mfc="white", label=label, zorder=3, **style)
    for at, end, row in zip(y, np.fmax(np.fmax(high, mean), 0), own.to_dict("records"), strict=True):
        if row["succeeded"] < row["trials"] or row["raised"]:
            text = f"{row['succeeded']}/{row['trials']}" + f", {row['raised']} raised" * bool(row["raised"])
            axes.annotate(text, (end, at), (5, 0), textcoords="offset points", fontsize=7, va="center")
