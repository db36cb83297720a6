"""Colours, labels and file formats shared by all figures; Matplotlib is imported only for drawing."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from simbias.core import Criterion, Quantity, Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers can distinguish.
SIMULATION, HARDWARE, NOMINAL = "#0072B2", "#D55E00", "#009E73"
OTHERS = ("#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000")
# For many series: grey instead of yellow, which is pale on white; the two lengths are coprime.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C8C8C")
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "<", ">", "p", "h")
GREEK = ("alpha", "beta", "gamma", "delta", "theta", "phi", "psi", "omega")
LIMIT, BEYOND = "0.35", "0.92"  # greys
SMALL = 8.5  # points
TICKS = {4.0: (1, 1.5, 2, 3, 4, 5, 7), 20.0: (1, 2, 3, 5), 200.0: (1, 3)}  # by upper over lower limit
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
FAR = 3  # decades from 1, beyond which an axis' numbers are written with powers of ten
PLAIN = (0.02, 1e4)  # largest numbers of an axis whose labels are short
LINE_OF_TEXT = 0.13  # of the height of axes, at most

DOTS_PER_INCH = 120
PUBLISHED_DOTS_PER_INCH = 200  # twice what a screen shows
DATES = {".svg": "Date", ".pdf": "CreationDate"}  # in their metadata, by file extension


class SeriesStyle(NamedTuple):
    """The color and the marker of a series."""

    color: str
    marker: str


def series_style(index: int) -> SeriesStyle:
    """A style for each series: colors and markers are unique among eight series, pairs among 88."""
    return SeriesStyle(COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)])


def label(quantity: Quantity | Criterion) -> str:
    """Name and unit, for an axis."""
    return with_unit(symbol(quantity.name), quantity.unit)


def with_unit(name: str, unit: str) -> str:
    """A name, and the unit if there is one."""
    return f"{name} ({unit})" if unit else name


def symbol(name: str) -> str:
    """A name for readers: `d_theta_1` as a Greek letter with index and dot, `d_angle` in words."""
    base, _, index = name.removeprefix("d_").partition("_")
    if base not in GREEK:
        return re.sub("^d ", "rate of ", name.replace("_", " "))
    letter = rf"\dot{{\{base}}}" if name.startswith("d_") else rf"\{base}"
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def literal(text: str) -> str:
    """The user's text, without mathematics; a leading underscore would hide it from legends."""
    words = text.replace("$", r"\$")
    return rf"$\_${words[1:]}" if words.startswith("_") else words


def seconds(task: Task, frame: int) -> float:
    """The time of a frame in s."""
    return frame * task.time_step


def shade_beyond(axes: Axes, limit: float, words: str, side: Literal["left", "right"] = "right") -> None:
    """Mark a limit on the vertical axis and shade the area beyond; call it after everything else is drawn.

    The words are below the limit, behind the curves. An infinite limit is not drawn.
    """
    from matplotlib.patheffects import withStroke

    if not np.isfinite(limit):
        return
    axes.axhline(limit, color=LIMIT, linewidth=0.8, zorder=1)
    scale = axes.yaxis.get_transform()
    bottom, top, at = scale.transform(np.array([*axes.get_ylim(), limit]))
    room = LINE_OF_TEXT * (top - bottom)
    bottom, top = scale.inverted().transform(np.array([min(bottom, at - room), max(top, at + room)]))
    axes.axhspan(limit, top, color=BEYOND, linewidth=0.0, zorder=0)
    axes.set_ylim(bottom, top)
    axes.annotate(
        words,
        (float(side == "right"), limit),
        xycoords=axes.get_yaxis_transform(),
        xytext=(-2 if side == "right" else 2, -3),
        textcoords="offset points",
        ha=side,
        va="top",
        fontsize=SMALL,
        color=LIMIT,
        zorder=0.5,
        path_effects=[withStroke(linewidth=2.0, foreground="white")],
    )


def logarithmic(*all_axis: Axis) -> None:
    """Scale axes logarithmically; ticks are at decades and, if few of these are visible, in between.

    A figure's labels are all alike: plain numbers or, if any of its axes reaches far, powers of ten.
    There are no minor ticks, as they would take most of a figure's drawing time.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    class Ticks(LogLocator):
        def tick_values(self, vmin: float, vmax: float) -> Any:
            subs = (subs for most, subs in TICKS.items() if vmax < most * vmin)
            self.set_params(subs=next(subs, (1,)))
            return super().tick_values(vmin, vmax)

    def number(axis: Axis, value: float, _: int | None) -> str:
        whole = axis.get_figure(root=True)
        beside = (each for axes in (whole.axes if whole else ()) for each in (axes.xaxis, axes.yaxis))
        alike = [axis, *(each for each in beside if each.get_scale() == "log")]
        ends = [end for each in alike for end in each.get_view_interval()]
        return f"{value:g}" if min(ends) >= 10.0**-FAR and max(ends) <= 10.0**FAR else with_power(value)

    for axis in all_axis:
        axis.axes.set(**{f"{axis.axis_name}scale": "log"})  # type: ignore[attr-defined]
        axis.set_major_locator(Ticks(numticks=8))
        axis.set_major_formatter(FuncFormatter(partial(number, axis)))
        axis.set_minor_locator(NullLocator())


def with_power(value: float) -> str:
    """A positive number with its power of ten."""
    exponent = math.floor(math.log10(value) + 1e-9)
    digits = f"{value / 10.0**exponent:g}"
    power = str(exponent).translate(SUPERSCRIPTS)  # faster to typeset than mathematics
    return f"{'' if digits == '1' else f'{digits}·'}10{power}"


def whole_numbers(*all_axis: Axis) -> None:
    """Put ticks only at whole numbers, even if there is only one."""
    from matplotlib.ticker import MaxNLocator

    for axis in all_axis:
        axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1, nbins=6))


def logarithmic_if_wide(values: Sequence[float], *all_axis: Axis) -> None:
    """Scale axes logarithmically if finite values are positive and range over more than a decade."""
    finite = [value for value in values if np.isfinite(value)]
    if 0 < 10 * min(finite) < max(finite):
        logarithmic(*all_axis)


def in_powers(values: Sequence[float], axis: Axis) -> str:
    """Label a linear axis in a power of ten if finite values are far from 1; return the power, or "".

    Long labels would leave no room for a narrow panel.
    """
    from matplotlib.ticker import FuncFormatter

    largest = max((abs(value) for value in values if np.isfinite(value)), default=1.0)
    if axis.get_scale() == "log" or not largest or PLAIN[0] <= largest < PLAIN[1]:
        return ""
    power = int(np.floor(np.log10(largest)))
    axis.set_major_formatter(FuncFormatter(lambda z, _: FuncFormatter.fix_minus(f"{z / 10.0**power:g}")))
    return with_power(10.0**power)


def plain(axes: Axes, grid: Literal["x", "y", "both"] | None = None) -> None:
    """Remove the frame's upper and right sides; an optional grid lies behind the curves."""
    axes.spines[["top", "right"]].set_visible(False)
    if grid is not None:
        axes.grid(axis=grid, color="0.9")
        axes.set_axisbelow(True)


def publish(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as name.png, .svg and .pdf; return their paths."""
    paths = [folder / f"{name}{suffix}" for suffix in (".png", *DATES)]
    for path in paths:
        save(figure, path)
    return paths


def save(figure: Figure, path: Path | str) -> None:
    """Write a figure as PNG, SVG or PDF, by the path's suffix; the same figure gives the same file.

    Raises
    ------
    ValueError
        If the path has another suffix.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        Path(path).write_bytes(png(figure, PUBLISHED_DOTS_PER_INCH, optimize=True))
    elif suffix in DATES:
        from matplotlib import rc_context

        # Journals refuse the fonts of type 3 that Matplotlib embeds by default.
        with rc_context({"svg.hashsalt": "simbias", "pdf.fonttype": 42}), _silence():
            figure.savefig(path, format=suffix[1:], facecolor="white", metadata={DATES[suffix]: None})
    else:
        raise ValueError(f"{path}: a figure is saved as .png, .svg or .pdf")


def png(figure: Figure, dots_per_inch: int = DOTS_PER_INCH, optimize: bool = False) -> bytes:
    """A figure as a PNG file of 256 colours: enough for line art, and files are a third as large."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure.set_dpi(dots_per_inch)
    canvas, file = FigureCanvasAgg(figure), BytesIO()
    with _silence():
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    picture.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=optimize)
    return file.getvalue()


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress warnings of labels that do not fit, or of letters missing in fonts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield
