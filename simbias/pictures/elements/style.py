"""Colours, labels and files that all figures share; Matplotlib is imported where something is drawn."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core import Criterion, Quantity, Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from PIL import Image

# Okabe and Ito's colours, which the colour-blind tell apart.
SIMULATION, HARDWARE, NOMINAL = "#0072B2", "#D55E00", "#009E73"
OTHERS = ("#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000")
GREEK = ("alpha", "beta", "gamma", "delta", "theta", "phi", "psi", "omega")
LIMIT, BEYOND = "0.35", "0.92"  # greys
SMALL = 8.5  # points

DOTS_PER_INCH = 120
PUBLISHED_DOTS_PER_INCH = 200  # twice what a screen shows


def label(quantity: Quantity | Criterion) -> str:
    """Name and unit, for an axis."""
    return f"{symbol(quantity.name)} ({quantity.unit})"


def symbol(name: str) -> str:
    """A name as it is read: `d_theta_1` as a Greek letter with an index and a dot, `board_angle` in words."""
    base, _, index = name.removeprefix("d_").partition("_")
    if base not in GREEK:
        return name.replace("_", " ")
    letter = rf"\dot{{\{base}}}" if name.startswith("d_") else rf"\{base}"
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def seconds(task: Task, frame: int) -> float:
    """When a frame is, in s."""
    return frame * task.time_step


def shade_beyond(axes: Axes, limit: float, words: str) -> None:
    """Mark a limit on the vertical axis and shade what lies beyond it; call it after all else is drawn."""
    axes.axhline(limit, color=LIMIT, linewidth=0.8, zorder=1)
    bottom, top = axes.get_ylim()
    if axes.get_yscale() == "linear":  # room for a line of text
        top = max(top, limit + 0.13 * (limit - bottom))
    axes.axhspan(limit, top, color=BEYOND, linewidth=0.0, zorder=0)
    axes.set_ylim(bottom, top)
    axes.annotate(
        words,
        (1.0, limit),
        xycoords=axes.get_yaxis_transform(),
        xytext=(-2, -3),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=SMALL,
        color=LIMIT,
    )


def logarithmic(axes: Axes, *names: str) -> None:
    """Scale the axes of these names, x or y; a tick a decade, as minor ones take most of a figure's time."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for name in names:
        axis: Axis = getattr(axes, f"{name}axis")
        axes.set(**{f"{name}scale": "log"})
        axis.set_major_locator(LogLocator(numticks=8))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"10{superscript(round(math.log10(value)))}"))
        axis.set_minor_locator(NullLocator())


def superscript(exponent: int) -> str:
    """An exponent in characters that are quicker to set than mathematics."""
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def plain(axes: Axes) -> None:
    """Take off the frame's upper and right side."""
    axes.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as PNG or, if the path ends so, as SVG; the same figure gives the same file."""
    if Path(path).suffix == ".svg":
        from matplotlib import rc_context

        with rc_context({"svg.hashsalt": "simbias"}), _silence():
            figure.savefig(path, format="svg", facecolor="white", metadata={"Date": None})
    else:
        render(figure, PUBLISHED_DOTS_PER_INCH).save(path, "PNG", optimize=True)


def png(figure: Figure) -> bytes:
    """A figure as a PNG file for a screen, made quickly."""
    file = BytesIO()
    render(figure, DOTS_PER_INCH).save(file, "PNG")
    return file.getvalue()


@contextmanager
def _silence() -> Iterator[None]:
    """Without warnings of labels for which there is no room, or of letters that no font has."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def render(figure: Figure, dots_per_inch: int) -> Image.Image:
    """A figure in pixels, of 256 colours: in line art none is missed, and files are a third as large."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(dots_per_inch)
    canvas = FigureCanvasAgg(figure)
    with _silence():
        canvas.draw()
    size = canvas.get_width_height()
    picture = Image.frombytes("RGBA", size, canvas.buffer_rgba().tobytes()).convert("RGB")
    return picture.quantize(256, dither=Image.Dither.NONE)
