"""Fig. 6: the cost on hardware over the iterations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from textwrap import fill

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from simbias.core.messages import counted
from simbias.core.records import Iteration
from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import HARDWARE, SIMULATION, literal, plain, shade_beyond, whole_numbers
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import Picture, SweepFigure, SweptTrials

WIDTH, HEIGHT = 3.6, 3.3  # of a panel, in
MOST_IN_A_ROW, LINE = 4, 40  # panels; characters of a panel's title
SPREAD = 0.3  # of an iteration, over which trials are spread so that none hides another


class Costs(SweepFigure):
    """Z_r of Algorithm 1 over its iterations: a line for each trial, a panel for each cell (Fig. 6)."""

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each iteration of each trial."""
        rows, limits = [], {}  # Z_max by cell, where it decides on success
        for row, trial in trials.in_full():
            if not trial.study.task.says_success:
                limits[trials.cell(row)] = trial.study.cost.max_cost
            rows += [
                {
                    "cell": trials.cell(row),
                    "repetition": row["repetition"],
                    "seed": row["seed"],
                    "iteration": iteration.index,
                    "experiments": iteration.total_experiments,
                    "predicted_cost": _prediction(iteration),
                    "hardware_cost": iteration.hardware_cost,
                    "succeeded": iteration.succeeded,
                }
                for iteration in trial.iterations
            ]
        numbers = pd.DataFrame(rows)
        panels = {str(cell): own for cell, own in numbers.groupby("cell", sort=False)}
        return Picture(_figure(panels, limits), numbers, _caption(panels, limits))


def _prediction(iteration: Iteration) -> float:
    """The cost that a search predicted; nan without one."""
    return math.nan if iteration.search is None else iteration.search.predicted_cost


def _figure(panels: dict[str, pd.DataFrame], limits: dict[str, float]) -> Figure:
    """Panels in rows, on the same scales."""
    columns = min(len(panels), MOST_IN_A_ROW)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(0.4 + WIDTH * columns, HEIGHT * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (title, own) in zip(grid.flat, panels.items(), strict=False):
        trials = [trial for _, trial in own.groupby("repetition")]
        for aside, trial in zip(np.linspace(-SPREAD / 2, SPREAD / 2, len(trials)), trials, strict=True):
            _line(axes, trial, float(aside) if len(trials) > 1 else 0.0)
        axes.set_title(fill(literal(title), LINE), fontsize="medium")
        whole_numbers(axes.xaxis)
        plain(axes)
    grid[0, 0].set_yscale("log")
    panel = dict(zip(panels, grid.flat, strict=False))
    for cell in sorted(limits, key=lambda each: -limits[each]):  # the highest first: all have the same scale
        shade_beyond(panel[cell], limits[cell], r"limit $Z_{\max}$")
    for axes in grid.flat[len(panels) :]:
        axes.axis("off")
    for axes in grid.flat[max(0, len(panels) - columns) : len(panels)]:
        axes.set_xlabel("iteration (trials side by side)")
        axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("cost Z on hardware (dimensionless)")
    ends = {ended for own in panels.values() for ended in own.groupby("repetition")["succeeded"].last()}
    marks = {
        "trial that succeeds": Line2D([], [], color=SIMULATION, marker="o"),
        "trial that never does": Line2D([], [], color=HARDWARE, marker="X", linestyle="--"),
    }
    both = zip(marks.items(), (True, False), strict=True)
    legend(figure, {name: mark for (name, mark), end in both if end in ends})
    return figure


def _line(axes: Axes, trial: pd.DataFrame, aside: float) -> None:
    """The iterations of a trial; a mark where it ends."""
    success = bool(trial["succeeded"].iloc[-1])
    x, y = trial["iteration"] + aside, trial["hardware_cost"]
    color, line, marker = (SIMULATION, "-", "o") if success else (HARDWARE, "--", "X")
    axes.plot(x, y, line, color=color, linewidth=1.0, alpha=0.8, marker=".", markersize=4)
    axes.plot(x.iloc[-1:], y.iloc[-1:], marker, color=color, markersize=6, zorder=3)


def _caption(panels: dict[str, pd.DataFrame], limits: dict[str, float]) -> str:
    """The caption, from the numbers."""
    sentences = []
    for title, own in panels.items():
        trials = [trial for _, trial in own.groupby("repetition")]
        lengths = [len(trial) for trial in trials if trial["succeeded"].iloc[-1]]
        when = ""
        if lengths and min(lengths) == max(lengths):
            when = f", after {counted(lengths[0], 'iteration')}"
        elif lengths:
            when = f", after {min(lengths)} to {max(lengths)} iterations (median {np.median(lengths):g})"
        where = f"{title}: " if title else ""
        sentences.append(f"{where}{len(lengths)} of {len(trials)} trials succeed{when}")
    limit = " or ".join(f"{each:g}" for each in dict.fromkeys(limits.values()))
    fails = f"; above the limit {limit} a policy has failed" * bool(limits)
    return (
        f"The greatest cost of an iteration's experiments on hardware, for each trial{fails}. "
        f"{'; '.join(sentences)}."
    )
