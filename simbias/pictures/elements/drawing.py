"""Drawings of a task's states, by the module beside the task.

For a task in `my_robot.py`, that module is `my_robot_drawing.py`:

    def draw(axes, task, state, *, color="0.4", muted=False):
        arm = Polygon(corners(task, state), facecolor=color, alpha=0.4 if muted else 1.0)
        return {"arm": axes.add_patch(arm)}

    def move(artists, task, state, *, muted=False):
        artists["arm"].set_xy(corners(task, state))
        artists["arm"].set_alpha(0.4 if muted else 1.0)

Snapshots need only `draw`; animations also need `move`. An optional `draws(task)` returns whether the task
can be drawn at all. All lengths are in one unit, so that all pictures of a trial have one scale. A task
declared in YAML declares its drawing there (`simbias.robots.declared.task`). A task without a drawing has all
other pictures; its overview lacks the snapshots.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from simbias.core import Task
from simbias.core.records import Array

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

TALLEST = 2.0  # height of a drawing's view, in widths
MARGIN = 0.03  # of its size, on each side


class NoPictureError(LookupError):
    """A picture that a task or a trial cannot have."""


class Drawing(Protocol):
    """Draws a task's state (n,) into axes and returns the artists by name; muted after a failure."""

    def __call__(
        self, axes: Axes, task: Any, state: Array, *, color: str = ..., muted: bool = ...
    ) -> Mapping[str, Artist]:
        """Draw; the caller sets the view, the same for all states."""


class Movement(Protocol):
    """Moves a drawing's artists to another state (n,); muted after a failure."""

    def __call__(self, artists: Mapping[str, Artist], task: Any, state: Array, *, muted: bool = ...) -> None:
        """Move; no artist is added."""


def drawing_of(task: Task) -> Drawing | None:
    """The function `draw` of the module `<the task's module>_drawing`, if there is such a module."""
    return cast(Drawing | None, _function(task, "draw"))


def movement_of(task: Task) -> Movement | None:
    """The function `move` of the module `<the task's module>_drawing`, if there is one."""
    return cast(Movement | None, _function(task, "move"))


def _function(task: Task, name: str) -> Any:
    """A function of the module that draws a task; None if there is none."""
    module = f"{type(task).__module__}_drawing"
    if importlib.util.find_spec(module) is None:
        return None
    found = importlib.import_module(module)
    draws = getattr(found, "draws", None)
    return getattr(found, name, None) if draws is None or draws(task) else None


def share_view(all_axes: Sequence[Axes]) -> None:
    """Give axes of equal shape, some of them empty, a common view and scale that contain all drawings.

    The view is at most twice as high as wide, so that a picture of a tall robot fits a screen.
    """
    if all_axes:
        corners = np.concatenate([axes.dataLim.get_points() for axes in all_axes if axes.has_data()])
        low, high = corners.min(axis=0), corners.max(axis=0)
        low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
        wider = max(0.0, (high[1] - low[1]) / TALLEST - (high[0] - low[0])) / 2
        low[0], high[0] = low[0] - wider, high[0] + wider
        for axes in all_axes:
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
