"""Dots of trials in rows, one for each cell of a sweep."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from simbias.core.records import Array, Flags

SPREAD = 0.8  # of a row's height, over which overlapping dots are spread
FEW, ASIDE = 5, 1.6 / 72  # dots that fit above each other; in, horizontal offset of more dots


def dot_marks(color: str) -> dict[str, Artist]:
    """Marks of a legend of trials."""
    dot: dict[str, Any] = {"color": color, "marker": "o", "markersize": 4, "linestyle": ""}
    return {
        "trial that succeeds": Line2D([], [], **dot),
        "trial that never does": Line2D([], [], markerfacecolor="white", **dot),
        "mean": Line2D([], [], color="0.2", marker="|", markersize=10, linestyle=""),
    }


def draw_dots(
    axes: Axes, row: int, values: Array, succeeded: Flags, color: str, alike: Array | None = None
) -> None:
    """Draw a cell's trials, values (k,): filled if successful, with a bar at their mean.

    Dots with the same value, or the same number of `alike` (k,), lie side by side.
    """
    if not len(values):
        return
    order = np.argsort(succeeded, kind="stable")  # hollow dots lie above filled ones
    values, faces = values[order], np.where(succeeded[order], color, "white")
    heights, sides = _aside(values if alike is None else alike[order])
    axes.vlines(values.mean(), row - 0.4, row + 0.4, color="0.2", linewidth=1.2, zorder=2)
    for side in (-1, 0, 1):
        shift = axes.transData + ScaledTranslation(side * ASIDE, 0, axes.figure.dpi_scale_trans)
        x, y, c = (each[sides == side] for each in (values, row + heights, faces))
        axes.scatter(x, y, s=11, c=c, edgecolors=color, linewidths=0.8, transform=shift, zorder=3)


def _aside(values: Array) -> tuple[Array, Array]:
    """Vertical offsets of dots (k,) that separate equal values, and their horizontal sides."""
    aside, sides = np.zeros((2, len(values)))
    for value in np.unique(values):
        equal = np.flatnonzero(values == value)
        order, count = np.arange(len(equal)), len(equal)
        aside[equal] = SPREAD * (order - (count - 1) / 2) / max(count, FEW)
        sides[equal] = (2 * (order % 2) - 1) * (count > FEW)
    return aside, sides
