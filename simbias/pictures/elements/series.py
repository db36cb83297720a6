"""Many series in one figure: looks that all differ, and a legend that is never cut."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

# Okabe and Ito's colours, but grey for their yellow, which is pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C8C8C")
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "<", ">", "p", "h")  # as many as share no factor with these
MOST_COLUMNS = 4  # of a legend
INCHES_OF_CHARACTER, INCHES_OF_HANDLE = 0.095, 0.6  # at most, with the space around it


class Look(NamedTuple):
    """How a series is drawn."""

    colour: str
    marker: str


def look(index: int) -> Look:
    """The look of a series: neither colour nor marker is repeated among eight, their pair not among 88."""
    return Look(COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)])


def draw_legend(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put a legend above all axes, in as many columns as there is room for; the figure grows by its height.

    The figure needs the constrained layout. Labels longer than the figure is wide are wrapped.
    """
    longest = int((figure.get_figwidth() - INCHES_OF_HANDLE) / INCHES_OF_CHARACTER)
    texts = [fill(label, longest) for label in labels]
    for columns in range(min(len(texts), MOST_COLUMNS), 0, -1):
        legend = figure.legend(handles, texts, loc="outside upper center", ncols=columns, frameon=False)
        extent = legend.get_window_extent()
        if extent.width <= figure.bbox.width or columns == 1:
            break
        legend.remove()
    figure.set_figheight(figure.get_figheight() + extent.height / figure.dpi)
