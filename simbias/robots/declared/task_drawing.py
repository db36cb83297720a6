"""A drawing of a declared task, to scale: discs, bars and polygons, or an image."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.image import AxesImage

from simbias.core.records import Array
from simbias.robots.declared.task import Declared
from simbias.robots.drawing import PALE, Disc, draw_parts, move_parts

IMAGE = "rendered"  # its artist's name


def draws(task: Declared) -> bool:
    """Whether there is anything to draw."""
    return bool(task.drawing) or task.image(task.start_mean) is not None


def draw(
    axes: Axes, task: Declared, state: Array, *, color: str = "0.4", muted: bool = False
) -> dict[str, Artist]:
    """Draw the task's parts at the state (n,); return the artists by name.

    Parts without their own grey have the given colour, and an image, which replaces a figure's parts, is
    tinted with it; a muted drawing is pale.
    """
    image, parts = task.image(state), _parts(task, state)
    if image is not None:
        parts = {name: part for name, part in parts.items() if task.drawing[name].points}
    colors = {name: color if part.grey is None else str(part.grey) for name, part in task.drawing.items()}
    artists = draw_parts(axes, parts, colors, muted)
    if image is None:
        return artists
    picture = AxesImage(axes, origin="upper", extent=image.extent, zorder=len(parts) + 1)
    picture.set_data(_tinted(image.pixels, color))
    picture.set_alpha(PALE if muted else 1.0)
    picture.set_gid(color)  # for `move`
    axes.add_image(picture)
    axes.update_datalim(np.reshape(image.extent, (2, 2)).T)
    return {**artists, IMAGE: picture}


def move(artists: Mapping[str, Artist], task: Declared, state: Array, *, muted: bool = False) -> None:
    """Move the artists of `draw` to another state (n,)."""
    picture = artists.get(IMAGE)
    if isinstance(picture, AxesImage) and (image := task.image(state)) is not None:
        picture.set_data(_tinted(image.pixels, picture.get_gid() or "0.4"))
        picture.set_extent(image.extent)
        picture.set_alpha(PALE if muted else 1.0)
    moved = {name: part for name, part in _parts(task, state).items() if name in artists}
    move_parts(artists, moved, muted)


def _parts(task: Declared, state: Array) -> dict[str, Disc | Array]:
    """The parts at a state (n,): a disc for one point, a bar for two, a polygon for more."""
    points, thickness = task.points(state), {name: part.thickness for name, part in task.drawing.items()}
    return {
        name: Disc(each[0], thickness[name] / 2) if len(each) == 1 else _corners(each, thickness[name])
        for name, each in points.items()
    }


def _tinted(pixels: Array, color: str) -> Array:
    """An image (k, k, 4), mixed equally with another colour of the same brightness."""
    brightness = pixels[..., :3].mean(axis=-1, keepdims=True)
    shade = np.clip(2.0 * brightness * np.array(to_rgb(color)), 0.0, 1.0)
    return np.concatenate([(pixels[..., :3] + shade) / 2, pixels[..., 3:]], axis=-1)


def _corners(points: Array, thickness: float) -> Array:
    """The corners (k, 2) of a polygon, or of a bar (4, 2) between two points."""
    if len(points) > 2:
        return points
    along = points[1] - points[0]
    across = thickness / 2 * np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-12)
    return np.array([points[0] + across, points[1] + across, points[1] - across, points[0] - across])
