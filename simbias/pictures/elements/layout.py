"""Figures of panels below a legend; Matplotlib's constrained layout places all labels."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from simbias.pictures.elements.style import SMALL

WIDTH = 9.0  # in, of a figure
BETWEEN = 0.08  # in, beside axes and their labels
PAD = 12  # points, below a headline
LABELS = 0.8  # in, part of a row's height for headline, ticks and labels
PAGE, COLUMN = 7.2, 3.5  # in, widths of a figure across a paper's page and in one of its two columns
LETTERS, SMALL_LETTERS = 10.0, 8.0  # points, of a figure across the page, and of a narrower one
NARROW = 5.0  # in, of figures with small letters
MOST_COLUMNS = 5  # of a legend
INCHES_OF_CHARACTER, INCHES_OF_HANDLE = 0.095, 0.6  # at most, with surrounding space


def panels(count: int, height: float, most: int = 3, blocks: int = 1) -> tuple[Figure, np.ndarray]:
    """An empty figure and its axes (blocks, count), about `height` inches high, at most `most` in a row."""
    columns = min(most, count)
    rows = -(-count // columns)  # of each block
    figure = Figure(figsize=(WIDTH, blocks * rows * (height + LABELS)), layout="constrained")
    figure.get_layout_engine().set(w_pad=BETWEEN)  # type: ignore[union-attr, call-arg]
    grid = figure.subplots(blocks * rows, columns, squeeze=False).reshape(blocks, rows * columns)
    for axes in grid[:, count:].flat:
        axes.axis("off")
    return figure, grid[:, :count]


def headline(axes: Axes, words: str, size: Literal["medium", "large"] = "medium") -> None:
    """Write words above axes, and above the exponents of the axes at the right.

    They may be wider than the axes, so only their height enters the layout.
    """
    axes.set_title(" ", fontsize=size, pad=PAD)
    text = axes.annotate(
        words,
        (0.0, 1.0),
        xycoords="axes fraction",
        xytext=(0, PAD),
        textcoords="offset points",
        fontsize=size,
        fontweight="bold",
    )
    text.set_in_layout(False)


def letters(width: float) -> float:
    """The size in points of the letters of a figure of this width in in."""
    return LETTERS if width >= NARROW else SMALL_LETTERS


def fitting(characters: int, width: float) -> int:
    """How many characters fit on a line of a figure of this width in in, if these do across the page."""
    return int(characters * width / PAGE * LETTERS / letters(width))


def legend(figure: Figure, entries: Mapping[str, Artist], title: str = "") -> None:
    """Put a legend above all axes, in as many columns as fit; the figure grows by its height.

    The figure needs the constrained layout. Labels longer than the figure is wide are wrapped.
    """
    size = letters(figure.get_figwidth()) / LETTERS * SMALL
    longest = int((figure.get_figwidth() - INCHES_OF_HANDLE) / INCHES_OF_CHARACTER)
    labels = [fill(label, longest) for label in entries]
    for columns in range(min(len(labels), MOST_COLUMNS), 0, -1):
        made = figure.legend(
            list(entries.values()),
            labels,
            loc="outside upper center",
            ncols=columns,
            frameon=False,
            fontsize=size,
            title=title,
            title_fontsize=size,
        )
        extent = made.get_window_extent()
        if extent.width <= figure.bbox.width or columns == 1:
            break
        made.remove()
    figure.set_figheight(figure.get_figheight() + extent.height / figure.dpi)
