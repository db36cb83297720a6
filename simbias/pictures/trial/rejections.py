"""Which samples were learned from, and why others were not (Section IV-C)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from simbias.core.records import Iteration, Selection
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.panels import headline, panels
from simbias.pictures.elements.style import HARDWARE, NOMINAL, OTHERS, SIMULATION, SMALL, plain
from simbias.trial.study import Study

BAR, MARGIN = 0.3, 0.2  # in, for each iteration and beside them
COLORS = (*OTHERS, HARDWARE, NOMINAL)
READABLE = 0.04  # of the longest bar: where a number has room


def rejections(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """For each iteration that learned, how many of the downsampled transitions became training data.

    The others are counted under the first criterion that rejected them. The last column is the size of D
    afterwards, which a cleared model begins anew (line 7 of Algorithm 1).

    Raises
    ------
    NoPictureError
        If no iteration learned.
    """
    lessons = [(iteration.index, iteration.learning) for iteration in iterations if iteration.learning]
    if not lessons:
        raise NoPictureError("nothing was learned from the trial's experiments")
    figure, grid = panels(1, 2, MARGIN + BAR * len(lessons))
    axes, aside = grid[0]
    rows, selections = [index for index, _ in lessons], [learning.selection for _, learning in lessons]
    names = dict.fromkeys(name for selection in selections for name in selection.rejected)
    ends, longest = np.zeros(len(rows)), max(1, *map(_count, selections))
    parts = {"accepted": ([len(selection.transitions) for selection in selections], SIMULATION)}
    for name, color in zip(names, cycle(COLORS), strict=False):
        counts = [selection.rejected.get(name, 0) for selection in selections]
        parts[f"rejected: {study.task.words(name)}"] = counts, color
    for words, (counts, color) in parts.items():
        if any(counts):
            bars = axes.barh(rows, counts, left=ends, color=color, label=words, height=0.75)
            texts = [str(count) if count > READABLE * longest else "" for count in counts]
            axes.bar_label(bars, texts, label_type="center", fontsize=SMALL, color=_readable_on(color))
            ends += counts
    for (index, learning), end in zip(lessons, ends, strict=True):
        reset = ", cleared before" if learning.reset else ""
        words = f"{len(learning.data)} in D{reset}"
        axes.annotate(words, (end, index), (4, 0), textcoords="offset points", va="center", fontsize=SMALL)
    axes.set(xlabel="transitions, after downsampling", ylabel="iteration", xlim=(0, 1.3 * longest))
    axes.invert_yaxis()
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    plain(axes)
    headline(axes, "Samples of each iteration's experiments")
    aside.axis("off")
    aside.legend(*axes.get_legend_handles_labels(), loc="upper left", frameon=False, fontsize=SMALL)
    return figure


def _count(selection: Selection) -> int:
    """How many transitions were judged."""
    return len(selection.transitions) + sum(selection.rejected.values())


def _readable_on(color: str) -> str:
    """Black or white."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "white" if 0.3 * red + 0.59 * green + 0.11 * blue < 140 else "black"
