"""Training samples, and the reasons for rejecting others (Section IV-C)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from simbias.core.records import Iteration
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.layout import headline, panels
from simbias.pictures.elements.style import (
    HARDWARE,
    NOMINAL,
    OTHERS,
    SIMULATION,
    SMALL,
    plain,
    whole_numbers,
)
from simbias.trial.study import Study

BAR, MARGIN = 0.3, 0.2  # in, for each iteration and beside them
COLORS = (*OTHERS, HARDWARE, NOMINAL)
READABLE = 0.04  # of the longest bar: minimum length for a number


def rejections(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """For each iteration that learned, how many of the downsampled transitions became training data.

    The others are counted under the first criterion that rejected them. Beside each bar is the size of D
    afterwards. It restarts when the model is cleared (line 7 of Algorithm 1), and a pass adds nothing.

    Raises
    ------
    NoPictureError
        If no iteration learned.
    """
    lessons = [(iteration, iteration.learning) for iteration in iterations if iteration.learning]
    if not lessons:
        raise NoPictureError("nothing was learned from the trial's experiments")
    rows, selections = [each.index for each, _ in lessons], [learning.selection for _, learning in lessons]
    names = dict.fromkeys(name for selection in selections for name in selection.rejected)
    bars = {"accepted": ([len(selection.transitions) for selection in selections], SIMULATION)}
    for name, color in zip(names, cycle(COLORS), strict=False):
        counts = [selection.rejected.get(name, 0) for selection in selections]
        bars[f"rejected: {study.task.words(name)}"] = counts, color
    longest = max(np.sum([counts for counts, _ in bars.values()], axis=0))
    if not longest:
        raise NoPictureError("no experiment of the trial gave a transition")
    figure, grid = panels(1, MARGIN + BAR * len(lessons))
    axes, ends = grid[0, 0], np.zeros(len(rows))
    for words, (counts, color) in bars.items():
        if any(counts):
            container = axes.barh(rows, counts, left=ends, color=color, label=words, height=0.75)
            texts = [str(count) if count > READABLE * longest else "" for count in counts]
            axes.bar_label(container, texts, label_type="center", fontsize=SMALL, color=_readable_on(color))
            ends += counts
    for (iteration, learning), end in zip(lessons, ends, strict=True):
        words = f"{len(learning.data)} in D{', cleared before' if learning.reset else ''}"
        words += ", a pass adds none" if iteration.succeeded else ""
        axes.annotate(
            words, (end, iteration.index), (4, 0), textcoords="offset points", va="center", fontsize=SMALL
        )
    axes.set(xlabel="transitions, after downsampling", ylabel="iteration", xlim=(0, 1.1 * longest))
    axes.invert_yaxis()
    whole_numbers(axes.xaxis, axes.yaxis)
    plain(axes)
    headline(axes, "Samples of each iteration's experiments; D: the data learned from")
    figure.legend(loc="outside right upper", frameon=False, fontsize=SMALL)
    return figure


def _readable_on(color: str) -> str:
    """Black or white, whichever is readable on this color."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "white" if 0.3 * red + 0.59 * green + 0.11 * blue < 140 else "black"
