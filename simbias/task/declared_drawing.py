"""A drawing of a declared task: discs, bars and polygons, to scale."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from simbias.records import Array
from simbias.task.declared import Declared, Part

LINE = "0.2"  # grey
PALE = 0.4  # opacity of what has failed


def draws(task: Declared) -> bool:
    """Whether there is anything to draw."""
    return bool(task.drawing)


def draw(
    axes: Axes, task: Declared, state: Array, *, color: str = "0.4", muted: bool = False
) -> dict[str, Artist]:
    """Draw the task's parts at the state (n,); return the artists by name.

    Parts that have no grey of their own are of the given colour; a muted drawing is pale.
    """
    axes.set_aspect("equal")
    axes.axis("off")
    artists: dict[str, Artist] = {}
    for order, (name, points) in enumerate(task.points(state).items()):
        part = task.drawing[name]
        patch = _disc(points[0], part) if len(points) == 1 else Polygon(_corners(points, part.thickness))
        patch.set_facecolor(color if part.grey is None else str(part.grey))
        patch.set_edgecolor(LINE)
        patch.set_linewidth(0.5)
        patch.set_alpha(PALE if muted else 1.0)
        patch.set_zorder(order)
        artists[name] = axes.add_patch(patch)
    return artists


def move(artists: Mapping[str, Artist], task: Declared, state: Array, *, muted: bool = False) -> None:
    """Move what `draw` has drawn to another state (n,)."""
    for name, points in task.points(state).items():
        artist = artists[name]
        if isinstance(artist, Polygon):
            artist.set_xy(_corners(points, task.drawing[name].thickness))
        elif isinstance(artist, Circle):
            artist.set_center(_pair(points[0]))
        artist.set_alpha(PALE if muted else 1.0)


def _disc(centre: Array, part: Part) -> Circle:
    """A disc about the centre (2,)."""
    return Circle(_pair(centre), part.thickness / 2)


def _corners(points: Array, thickness: float) -> Array:
    """The corners (k, 2) of a polygon, or of a bar (4, 2) between two points."""
    if len(points) > 2:
        return points
    along = points[1] - points[0]
    across = thickness / 2 * np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-12)
    return np.array([points[0] + across, points[1] + across, points[1] - across, points[0] - across])


def _pair(point: Array) -> tuple[float, float]:
    """The coordinates of a point (2,)."""
    return float(point[0]), float(point[1])
