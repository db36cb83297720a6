"""Comparison of methods over all cells of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from matplotlib.transforms import ScaledTranslation

from simbias.core.records import Array
from simbias.pictures.elements.style import SIMULATION, SMALL, literal, plain, series_style
from simbias.sweep.axes import Axis, in_words
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import UNTESTED, FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.grid import Sweep
from simbias.sweep.scores import HOLDS, SCORE, Method, against, scored
from simbias.sweep.statistics import episodes_needed, performance_profile
from simbias.sweep.tables import untested

WIDTH, ROW, CURVES, REST = 7.2, 0.19, 2.9, 2.0  # in: width; heights of a method's row, the curves, the rest
TINY = 7  # points
LETTERS = 34  # per line of a method's name
MOST = 8  # curves in a panel
BELOW, LOWEST = 1.6 / 72, 3  # in, offset of a curve below an identical one; the most offsets
SLANTED: dict[str, Any] = {"rotation": 55, "ha": "right", "va": "top", "rotation_mode": "anchor"}
THRESHOLDS = np.linspace(0, 1, 101)


class Comparison(SweepFigure):
    """Compares the points of an axis over the cells of the other axes, by what their last policies hold.

    A trial's score is the share of test episodes that its last policy passes: they succeed, and last to their
    end. The trial counts as a success if that policy holds (`simbias.sweep.statistics.holds`). Trials that
    raised an error or ended without a test are left out; counts by `holds` also leave out those with too few
    episodes. Only in the caption's ranking of methods do errors count against them. Above: mean score in each
    cell, and the interquartile mean with its bootstrap interval. Below: performance profiles, and the share
    of successful trials within a number of experiments. Intervals and tests are over cells, since trials of a
    cell may be copies of one, as for LQR: a Wilson interval uses the number of cells as the number of trials.
    For a single cell, they are over its trials; trials with the same policy count once.

    Parameters
    ----------
    axis
        The axis whose points are compared.
    references
        Points with which all others are compared: by the probability of improvement, and by exact sign tests
        on the cells' shares of successful trials, or on a single cell's pairs of trials, with Holm's
        correction over all tests against one reference.
    curves
        Points whose curves are drawn; by default the first eight.
    """

    reads_trials = False
    reads_tests = True

    def __init__(
        self,
        axis: str,
        references: list[str] = [],  # noqa: B006 (read only)
        curves: list[str] = [],  # noqa: B006
    ) -> None:
        self._axis, self._references, self._curves = axis, references, curves

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each method.

        Raises
        ------
        FigureError
            If no policy was tested, no trial ended without an error, or there is no such axis or point.
        """
        labels = {axis.name: {*axis.labels, *axis.left_out} for axis in trials.sweep.axes}
        named = [*self._references, *self._curves]
        if self._axis not in labels or set(named) - labels[self._axis]:
            raise FigureError(f"no such axis or point: {self._axis}, {', '.join(named)}")
        if not any(row["test_episodes"] for row in trials.rows):
            raise FigureError(UNTESTED)
        table = scored(trials.table, trials.sweep.report.bar)
        apart = [axis for axis in trials.sweep.axes if axis.name != self._axis]
        others = [axis.name for axis in apart]
        groups = table.groupby(self._axis, sort=False)
        own = {str(name): Method(each, others) for name, each in groups if each[SCORE].notna().any()}
        numbers = pd.DataFrame([method.row(name) for name, method in own.items()])
        for name in self._references:
            if name in own:
                numbers = numbers.join(against(own, own[name]).add_suffix(f" {name}"), on="method")
        curves = {name: own[name] for name in (self._curves or [*own][:MOST]) if name in own}
        figure = _figure(own, numbers, curves, apart)
        units = {"cells" if len(method.tried) > 1 else "different policies" for method in own.values()}
        caption = _caption(numbers, trials.sweep, " or ".join(sorted(units)))
        if compared := [name for name in self._references if name in own and numbers[f"p {name}"].any()]:
            caption += f" p in the table: sign tests against {' and '.join(compared)}, Holm-corrected."
        if len(curves) < len(own):
            caption += f" Curves are of {len(curves)} of {len(own)} methods."
        if gone := [str(name) for name in groups.groups if name not in own]:
            caption += f" All trials of {', '.join(gone)} are left out."
        return Picture(figure, numbers, caption + untested(row["test_episodes"] for row in trials.rows))


def _caption(numbers: pd.DataFrame, sweep: Sweep, units: str) -> str:
    """The caption, from the numbers and what intervals are over."""
    shares = (numbers["holds"] / (numbers["judged"] + numbers["raised"])).where(numbers["judged"] > 0)
    best = numbers[shares == shares.max()].to_dict("records")
    held = ", ".join(map(_held, best))
    alike = len(best) == shares.count() > 1
    often = f"{'equally' if alike else 'most'} often"
    most = f" Policies hold {often} with {held}; Wilson intervals are over {units}."
    if not shares.any():
        most = " No trial ends with a policy that holds." * bool(shares.count())
    spread = f", with its 95% bootstrap interval over {units}"
    spread *= bool(numbers["share_low"].notna().any())
    few = int((numbers["trials"] - numbers["judged"]).sum())
    needed = episodes_needed(sweep.report.bar)
    takes = f", which takes {needed} test episodes: {few} trials have fewer and do not count" * bool(few)
    return (
        f"Above: share of test episodes in which the last policy {sweep.success}, long ones to their end, "
        f"mean of each cell; at the right the interquartile mean{spread}. "
        "Below: share of trials that exceed a given share of test episodes; share of trials that end within "
        "a given number of experiments (without success, within all that they may make) with a policy that "
        f"holds (lower Wilson limit above {sweep.report.bar:.0%}{takes}); curves that are the same lie one "
        f"below the other.{most}"
    )


def _held(row: dict[Any, Any]) -> str:
    """How many of a method's trials end with a policy that holds, and how many raised an error."""
    raised = f", {row['raised']} raised" * bool(row["raised"])
    low, high = row["holds_low"], row["holds_high"]
    return f"{row['method']} {row['holds']} of {row['judged']} ({low:.0%} to {high:.0%}{raised})"


def _figure(
    methods: dict[str, Method], numbers: pd.DataFrame, curves: dict[str, Method], apart: Sequence[Axis]
) -> Figure:
    """The figure of two rows; a cell is a point of the axes apart from the methods'."""
    above = ROW * sum(1 + _label(*each).count("\n") for each in methods.items()) + REST
    figure = Figure(figsize=(WIDTH, above + CURVES), layout="constrained")
    rows: Any = figure.subfigures(2, 1, height_ratios=[above, CURVES])
    top, bottom = rows
    cells, mean = top.subplots(1, 2, width_ratios=[2.6, 1.0], sharey=True)
    _draw_cells(cells, methods, apart)
    _draw_means(mean, numbers)
    _draw_curves(bottom, curves)
    return figure


def _label(name: str, method: Method) -> str:
    """A method's name and its number of trials with errors, in lines."""
    return fill(literal(name) + f", {method.raised} raised" * bool(method.raised), LETTERS)


def _draw_cells(axes: Axes, methods: dict[str, Method], apart: Sequence[Axis]) -> None:
    """A row for each method, a column for each cell."""
    means = [{cell: own.mean() for cell, own in method.scores.items()} for method in methods.values()]
    names = [*dict.fromkeys(cell for own in means for cell in own)]
    shares = np.array([[own.get(cell, np.nan) for cell in names] for own in means])
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.25, aspect="auto")
    for (row, column), share in np.ndenumerate(shares):
        if np.isfinite(share):
            color = "white" if share > 0.8 else "0.25"
            axes.text(column, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=TINY, color=color)
    ticks = [fill(literal(in_words(apart, name)), 26) for name in names]
    axes.set_xticks(range(len(names)), ticks, fontsize=TINY, **SLANTED)
    axes.set_yticks(range(len(methods)), [_label(*each) for each in methods.items()], fontsize=8)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title("% of test episodes passed", fontsize=8)


def _draw_means(axes: Axes, numbers: pd.DataFrame) -> None:
    """Interquartile means with their intervals."""
    spread = np.abs(numbers[["share_low", "share_high"]].to_numpy().T - numbers["share"].to_numpy())
    y = range(len(numbers))
    axes.errorbar(numbers["share"], y, xerr=spread, fmt="o", color=SIMULATION, capsize=2, markersize=4)
    axes.set_title("interquartile mean", fontsize=8)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(-0.03, 1.03)
    axes.tick_params(axis="y", length=0, labelleft=False)
    plain(axes, "both")


def _draw_curves(figure: SubFigure, methods: dict[str, Method]) -> None:
    """Performance profiles, and the share of trials that hold against experiments."""
    left, right = figure.subplots(1, 2)
    most = max(float(method.trials["experiments"].max()) for method in methods.values())
    handles = {}
    for index, (name, method) in enumerate(methods.items()):
        color, marker = series_style(index)
        style = {"color": color, "marker": marker, "markersize": 4, "linewidth": 1.4}
        profile = performance_profile(method.trials[SCORE].to_numpy(), THRESHOLDS)
        handles[name] = _draw_curve(left, THRESHOLDS, profile, markevery=(2 * index, 20), **style)
        if judged := method.trials[HOLDS].count():
            held = method.trials.loc[method.trials[HOLDS] == 1, "experiments"]
            experiments, counts = np.unique(held.to_numpy(dtype=float), return_counts=True)
            share = np.cumsum([0, *counts, 0]) / judged
            _draw_curve(right, np.array([0.0, *experiments, most]), share, drawstyle="steps-post", **style)
    if not right.lines:
        right.text(0.5, 0.5, "too few test episodes", transform=right.transAxes, ha="center")
        right.set_xticks([])
    left.set_xlabel("test episodes passed", fontsize=SMALL)
    left.set_ylabel("trials with more", fontsize=SMALL)
    left.xaxis.set_major_formatter(PercentFormatter(1.0))
    right.set_xlabel("hardware experiments", fontsize=SMALL)
    right.set_ylabel("trials whose last policy holds", fontsize=SMALL)
    for axes in (left, right):
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_ylim(-0.03, 1.03)
        plain(axes, "both")
    figure.legend(
        handles.values(),
        [_label(name, methods[name]) for name in handles],
        loc="outside lower center",
        ncols=3,
        fontsize=8,
        frameon=False,
    )


def _draw_curve(axes: Axes, x: Array, y: Array, **style: Any) -> Line2D:
    """A curve, drawn slightly below identical ones."""
    same = sum(np.array_equal(line.get_xydata(), np.column_stack([x, y])) for line in axes.lines)
    below = min(same, LOWEST) * BELOW
    (line,) = axes.plot(x, y, **style)
    line.set_transform(axes.transData + ScaledTranslation(0, -below, axes.figure.dpi_scale_trans))
    return line
