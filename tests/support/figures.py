"""Reading figures: their words, and the data of their lines."""

from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from simbias.core.records import Array


def texts(figure: Figure) -> str:
    """All words of a figure."""
    words = []
    for axes in figure.axes:
        legend = axes.get_legend()
        words += [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
        words += [text.get_text() for text in axes.texts + (legend.get_texts() if legend else [])]
    words += [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    return "\n".join(words)


def lines(axes: Axes, color: str, marker: str = "None") -> list[Array]:
    """The data (k, 2) of the lines of a colour and marker."""
    own = [line for line in axes.lines if line.get_marker() == marker]
    return [line.get_xydata() for line in own if to_hex(line.get_color()).upper() == color]
