"""A figure of panels: a legend, then rows of axes under headlines; laid out in inches, which is quick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from simbias.pictures.elements.style import SMALL

WIDTH, LEGEND = 9.0, 0.3  # in, of the figure and the height of its legend
LEFT, RIGHT, BETWEEN = 0.74, 0.12, 0.74  # in, beside panels
HEADLINE, BELOW = 0.32, 0.52  # in, above and below each row


def panels(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    """An empty figure and its axes (rows, columns), each of a height in inches."""
    row_height = HEADLINE + height + BELOW
    total = LEGEND + rows * row_height
    width = (WIDTH - LEFT - RIGHT - (columns - 1) * BETWEEN) / columns
    figure = Figure(figsize=(WIDTH, total))
    grid = np.empty((rows, columns), dtype=object)
    for row, column in np.ndindex(rows, columns):
        left, bottom = LEFT + column * (width + BETWEEN), (rows - 1 - row) * row_height + BELOW
        grid[row, column] = figure.add_axes((left / WIDTH, bottom / total, width / WIDTH, height / total))
    return figure, grid


def headline(axes: Axes, words: str) -> None:
    """Write words above axes, from the left end of what belongs to them."""
    axes.annotate(
        words,
        (0.0, 1.0),
        xycoords="axes fraction",
        xytext=(-72 * LEFT + 7, 72 * HEADLINE - 7),
        textcoords="offset points",
        va="top",
        fontweight="bold",
    )


def legend(figure: Figure, entries: Mapping[str, Any]) -> None:
    """Say at the top what lines and markers mean."""
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="upper left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        ncols=len(entries),
        frameon=False,
        fontsize=SMALL,
        handlelength=1.8,
        columnspacing=1.5,
    )
