"""Success rates of the last policies of a sweep's trials, and how many experiments they took."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter

from simbias.core.ranges import FigureWidth
from simbias.pictures.elements.dots import dot_marks, draw_dots
from simbias.pictures.elements.layout import PAGE, fitting, legend, letters
from simbias.pictures.elements.style import HARDWARE, LIMIT, SIMULATION, literal, plain
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import UNTESTED, FigureError, Picture, SweepFigure, SweptTrials
from simbias.sweep.grid import LASTS
from simbias.sweep.tables import RELIABLE, failures, numbers_of_episodes, success_rate, untested

ROW, REST = 0.3, 1.1  # in: per cell; the rest
CHARACTERS, LINE = 44, 0.17  # per line of a cell's label, across the page; in, its height
BESIDE = 0.06  # of an axis, beside its last dots across the page, so that they are not clipped
WORDS = 36  # characters per line of an axis' label, across the page
COLORS = {"experiments": SIMULATION, "success_rate": HARDWARE}


class LastPolicies(SweepFigure):
    """Each trial of each cell: its experiments, and the share of test episodes that its last policy passes.

    A dot is a trial, a bar the mean of its cell. If the task defines no success, a long test episode counts
    if it lasts for the task's horizon, even if it fails later; `Comparison` requires it to reach its end.
    """

    reads_trials = False
    reads_tests = True

    def __init__(self, width: FigureWidth = PAGE) -> None:
        self._width = width

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each trial.

        Raises
        ------
        FigureError
            If no policy was tested.
        """
        rows = [row for row in trials.rows if row["test_episodes"]]
        if not rows:
            raise FigureError(UNTESTED)
        cells = [cell.labels for cell in trials.sweep.cells]
        numbers = pd.DataFrame(
            {
                "cell": [trials.cell(row) for row in rows],
                "repetition": [row["repetition"] for row in rows],
                "succeeded": [row["outcome"] == "succeeded" for row in rows],
                "experiments": [row["experiments"] for row in rows],
                "success_rate": [success_rate(row["test_episodes"]) for row in rows],
            },
            index=[cells.index(trials.labels(row)) for row in rows],
        )
        episodes = numbers_of_episodes(row["test_episodes"] for row in rows)
        success = trials.sweep.success
        lasting = "test episodes that last\nfor the horizon"
        words = lasting if success == LASTS else "success rate of the last policy"
        figure = _figure(numbers, [*map(trials.sweep.words, cells)], words, self._width)
        caption = _caption(numbers, episodes, success, failures(trials.table))
        caption += untested(row["test_episodes"] for row in trials.rows)
        return Picture(figure, numbers, caption)


def _caption(numbers: pd.DataFrame, episodes: str, success: str, failing: str) -> str:
    """The caption, from the numbers."""
    enough = numbers["success_rate"] >= RELIABLE
    solved = enough.groupby(level=0).mean() >= RELIABLE
    return (
        "Dots: trials, filled where they succeeded; bars: means. Left: hardware experiments until success, "
        f"without it all that a trial may make{failing}. Right: the share of "
        f"{episodes} test episodes in which its last policy {success}. {enough.sum()} of {len(numbers)} "
        f"trials end with a policy that does in at least {RELIABLE:.0%} of them (dashed); nine in ten "
        f"trials do in {solved.sum()} of {len(solved)} cells."
    )


def _figure(numbers: pd.DataFrame, cells: Sequence[str], words: str, width: float) -> Figure:
    """Experiments beside shares, with a row for each cell, the first on top."""
    labels = [fill(literal(cell), fitting(CHARACTERS, width)) for cell in cells]
    row = max(ROW, LINE * (1 + max(label.count("\n") for label in labels)))
    figure = Figure(figsize=(width, row * len(cells) + REST), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.6))
    for axes, column, label in ((left, "experiments", "experiments"), (right, "success_rate", words)):
        for place in range(len(cells)):
            own = numbers[numbers.index == place]
            succeeded = own["succeeded"].to_numpy(dtype=bool)
            draw_dots(axes, place, own[column].to_numpy(dtype=float), succeeded, COLORS[column])
        axes.set_xlabel(
            fill(label, fitting(WORDS, width)) if width < PAGE else label, fontsize=letters(width)
        )
        axes.tick_params(labelsize=letters(width))
        plain(axes, "x")
    beside = BESIDE * PAGE / width
    left.set_xlim(0, (1 + beside) * numbers["experiments"].max())
    left.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    right.set_xlim(-beside / 2, 1 + beside / 2)
    right.xaxis.set_major_formatter(PercentFormatter(1.0))
    right.axvline(RELIABLE, color=LIMIT, linewidth=0.8, linestyle="--", zorder=0)
    left.set_yticks(range(len(cells)), labels)
    left.set_ylim(len(cells) - 0.4, -0.6)
    reliable = Line2D([], [], color=LIMIT, linewidth=0.8, linestyle="--")
    legend(figure, {**dot_marks("0.2"), f"{RELIABLE:.0%} of episodes": reliable})
    return figure
