"""Parts of a drawing: discs and polygons that are drawn once, then moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from simbias.core.records import Array

LINE = "0.2"  # grey
PALE = 0.4  # opacity of failed robots


class Disc(NamedTuple):
    """A disc about a centre (2,)."""

    centre: Array
    radius: float


Parts = Mapping[str, Disc | Array]  # from back to front; the corners (k, 2) of polygons


def draw_parts(axes: Axes, parts: Parts, colors: Mapping[str, str], muted: bool) -> dict[str, Artist]:
    """Draw parts to scale, each in its colour, pale if muted; return the artists by name."""
    axes.set_aspect("equal")
    axes.axis("off")
    artists: dict[str, Artist] = {}
    for order, (name, part) in enumerate(parts.items(), start=1):
        patch = Circle(_pair(part.centre), part.radius) if isinstance(part, Disc) else Polygon(part)
        patch.set(facecolor=colors[name], edgecolor=LINE, linewidth=0.5, joinstyle="round", zorder=order)
        patch.set_alpha(PALE if muted else 1.0)
        artists[name] = axes.add_patch(patch)
    return artists


def move_parts(artists: Mapping[str, Artist], parts: Parts, muted: bool) -> None:
    """Move the artists of `draw_parts`, which is much faster than redrawing."""
    for name, part in parts.items():
        artist = artists[name]
        if isinstance(artist, Circle) and isinstance(part, Disc):
            artist.set_center(_pair(part.centre))
        elif isinstance(artist, Polygon) and not isinstance(part, Disc):
            artist.set_xy(part)
        artist.set_alpha(PALE if muted else 1.0)


def _pair(point: Array) -> tuple[float, float]:
    """The coordinates of a point (2,)."""
    return float(point[0]), float(point[1])
