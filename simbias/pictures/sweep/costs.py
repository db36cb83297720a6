"""Fig. 6: the cost on hardware over the iterations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from simbias.interfaces import SweepFigure
from simbias.pictures.style import HARDWARE, SIMULATION, SMALL, plain, shade_beyond
from simbias.pictures.sweep.batches import Outcomes
from simbias.pictures.sweep.picture import Picture
from simbias.pictures.sweep.swept import SweptTrials

WIDTH, HEIGHT = 3.6, 3.3  # of a panel, in
SPREAD = 0.3  # of an iteration, over which trials are moved aside so that none hides another


class Costs(SweepFigure):
    """Z_r of Algorithm 1 over its iterations: a line for each trial, a panel for each cell (Fig. 6)."""

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each iteration of each trial."""
        rows = []
        for row, trial in trials.recorded():
            max_cost = trial.study.cost.max_cost
            rows += [
                {
                    "cell": trials.cell(row),
                    "repetition": row["repetition"],
                    "seed": row["seed"],
                    "iteration": iteration.index,
                    "experiments": iteration.total_experiments,
                    "predicted_cost": iteration.predicted_cost,
                    "hardware_cost": iteration.hardware_cost,
                    "succeeded": iteration.succeeded,
                }
                for iteration in trial.iterations
            ]
        numbers = pd.DataFrame(rows)
        panels = {str(cell): own for cell, own in numbers.groupby("cell", sort=False)}
        return Picture(_figure(panels, max_cost), numbers, _caption(panels, max_cost))


def _figure(panels: dict[str, pd.DataFrame], max_cost: float) -> Figure:
    """Panels side by side, on the same scales."""
    figure = Figure(figsize=(0.4 + WIDTH * len(panels), HEIGHT + 0.4), layout="constrained")
    row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (title, own) in zip(row, panels.items(), strict=True):
        trials = [trial for _, trial in own.groupby("repetition")]
        for aside, trial in zip(np.linspace(-SPREAD / 2, SPREAD / 2, len(trials)), trials, strict=True):
            _line(axes, trial, float(aside) if len(trials) > 1 else 0.0)
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("iteration")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        plain(axes)
    row[0].set_yscale("log")
    row[0].set_ylabel("cost Z on hardware (dimensionless)")
    for axes in row:
        shade_beyond(axes, max_cost, r"limit $Z_{\max}$")
    handles = [
        Line2D([], [], color=SIMULATION, marker="o", label="trial that succeeds"),
        Line2D([], [], color=HARDWARE, marker="X", linestyle="--", label="trial that never does"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False, fontsize=SMALL)
    return figure


def _line(axes: Axes, trial: pd.DataFrame, aside: float) -> None:
    """The iterations of a trial; a mark where it ends."""
    succeeded = bool(trial["succeeded"].iloc[-1])
    x, y = trial["iteration"] + aside, trial["hardware_cost"]
    color, line, marker = (SIMULATION, "-", "o") if succeeded else (HARDWARE, "--", "X")
    axes.plot(x, y, line, color=color, linewidth=1.0, alpha=0.8, marker=".", markersize=4)
    axes.plot(x.iloc[-1:], y.iloc[-1:], marker, color=color, markersize=6, zorder=3)


def _caption(panels: dict[str, pd.DataFrame], max_cost: float) -> str:
    """What is seen."""
    told = []
    for title, own in panels.items():
        trials = [trial for _, trial in own.groupby("repetition")]
        ended = [len(trial) for trial in trials if trial["succeeded"].iloc[-1]]
        when = (
            f", after {min(ended)} to {max(ended)} iterations (median {np.median(ended):g})" if ended else ""
        )
        where = f"{title}: " if title else ""
        told.append(f"{where}{len(ended)} of {len(trials)} trials end below the limit{when}")
    return (
        f"The greatest cost of an iteration's experiments on hardware, for each trial; above the limit "
        f"{max_cost:g} a policy has failed. {'; '.join(told)}."
    )
