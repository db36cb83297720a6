"""Table II as a figure: experiments along an axis, with their intervals, and the paper's."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from simbias.core.proportions import CONFIDENCE
from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import literal, plain, series_style
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import NONE_ENDED, FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.statistics import FEWEST
from simbias.sweep.tables import cells, heads

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from simbias.sweep.axes import Axis
    from simbias.sweep.grid import Sweep

HEIGHT, LINE = 3.75, 0.15  # in, without the legend and the ticks; of a line of these
NARROWEST, WIDEST, BESIDE = 5.0, 16.0, 0.8  # in; beside the axes
LETTER, SHORTEST = 0.085, 8  # in, of a tick's label; letters of its shortest lines
PAPER_ASIDE = 0.12  # of the distance between two points of the axis


class Experiments(SweepFigure):
    """Table II: mean number of experiments of each cell, along the first axis that is not in columns.

    Bars are bootstrap intervals, hollow markers the paper's means; where not every trial succeeded, a
    fraction says how many did, and how many raised an error.
    """

    reads_trials = False

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are the table of `simbias.sweep.tables.cells`."""
        if not trials.sweep.axes:
            raise FigureError("the sweep has no axis along which to draw its cells")
        table = cells(trials.table, trials.sweep)
        if not table["trials"].any():
            raise FigureError(NONE_ENDED)
        return Picture(_figure(table, trials.sweep), table, _caption(table))


def _caption(table: pd.DataFrame) -> str:
    """The caption, from the numbers."""
    trials, successes = table["trials"].sum(), table["succeeded"].sum()
    papers = "; hollow: the paper's means" if table["paper"].notna().any() else ""
    fewer, paper = (table["mean"] < table["paper"]).sum(), table["paper"].notna().sum()
    against = f" In {fewer} of {paper} cells the mean is below the paper's." if paper else ""
    return (
        f"Mean number of hardware experiments until success, with {CONFIDENCE:.0%} bootstrap intervals "
        f"(of {FEWEST} trials at least, not all equal){papers}. {successes} of {trials} trials succeeded "
        "(above cells: of their own, if not all, and how many raised an error); "
        "one that did not counts all that it may make."
        f"{against}"
    )


def _figure(table: pd.DataFrame, sweep: Sweep) -> Figure:
    """The cells along an axis, a curve for each combination of the others."""
    from matplotlib.figure import Figure  # lazily: a sweep is announced before anything is drawn

    along = next((axis for axis in sweep.axes if axis.name != sweep.report.columns), sweep.axes[0])
    others = [axis for axis in sweep.axes if axis is not along]
    curves = list(itertools.product(*(axis.labels for axis in others)))
    count = len(along.labels)
    texts = [[literal(text).replace("_", "_ ") for text in point] for point in along.texts]  # may break there
    longest = max((len(word) for point in texts for text in point for word in text.split()), default=0)
    room = max(0.3 * (1 + len(curves)) * count + 2.0, LETTER * longest * count + BESIDE)
    width = min(max(NARROWEST, room), WIDEST)
    letters = max(SHORTEST, round((width - BESIDE) / count / LETTER))
    ticks = ["\n".join(fill(text, letters).replace("_ ", "_") for text in point) for point in texts]
    lines = 1 + max(tick.count("\n") for tick in ticks)
    figure = Figure(figsize=(width, HEIGHT + LINE * lines), layout="constrained")
    axes = figure.add_subplot()
    for index, labels in enumerate(curves):
        own = table
        for axis, label in zip(others, labels, strict=True):
            own = own[own[axis.name] == label]
        offset = 0.5 * (index - (len(curves) - 1) / 2) / max(len(curves), 2)
        _curve(axes, own, offset, index, literal(", ".join(labels)), len(curves) > 1)
    _label(axes, along, ticks)
    axes.set_ylim(bottom=0)
    axes.locator_params(axis="y", integer=True)
    axes.set_xlim(-0.6, len(along.labels) - 0.4)
    axes.set_ylabel("hardware experiments until success")
    if len(curves) > 1 or bool(table["paper"].notna().any()):
        legend(figure, _ours_first(axes), literal(", ".join("/".join(heads(axis)) for axis in others)))
    return figure


def _ours_first(axes: Axes) -> dict[str, Artist]:
    """The entries of a legend, the paper's last."""
    handles, labels = axes.get_legend_handles_labels()
    entries = zip(labels, handles, strict=True)
    return dict(sorted(entries, key=lambda entry: entry[0].endswith("paper")))


def _curve(axes: Axes, own: pd.DataFrame, offset: float, index: int, name: str, narrow: bool) -> None:
    """The cells of one curve, moved sideways so that no interval hides another, nor a fraction if narrow."""
    x = np.arange(len(own)) + offset
    mean, low, high = (own[column].to_numpy(dtype=float) for column in ("mean", "low", "high"))
    color, marker = series_style(index)
    spread = np.nan_to_num(np.clip([mean - low, high - mean], 0, None))
    axes.errorbar(x, mean, spread, fmt=marker, color=color, capsize=3, markersize=5, label=name or "ours")
    paper = own["paper"].to_numpy(dtype=float)
    if not np.isnan(paper).all():
        label = f"{name}, paper" if name else "paper"
        axes.plot(x + PAPER_ASIDE, paper, marker, color=color, mfc="white", markersize=5, label=label)
    for at, top, row in zip(x, np.fmax(np.fmax(high, mean), 0), own.to_dict("records"), strict=True):
        if row["succeeded"] < row["trials"] or row["raised"]:
            text = f"{row['succeeded']}/{row['trials']}" + f"\n{row['raised']} raised" * bool(row["raised"])
            fraction = axes.annotate(text, (at, top), (0, 5), textcoords="offset points", fontsize=7)
            fraction.set(ha="center", va="bottom", rotation=90 * narrow)


def _label(axes: Axes, along: Axis, ticks: Sequence[str]) -> None:
    """The points of the axis and what they are; ticks of points of several values have a line for each."""
    axes.set_xticks(range(len(ticks)), ticks)
    names = heads(along)
    axes.set_xlabel(names[0] if len(names) == 1 else "from above: " + ", ".join(names))
    plain(axes, "y")
