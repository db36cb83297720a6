"""Snapshots of rollouts (Fig. 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from simbias.core import Task
from simbias.core.records import Array, Rollout
from simbias.pictures.elements.drawing import Drawing, NoPictureError, drawing_of, share_view
from simbias.pictures.elements.style import HARDWARE, SMALL, seconds


def snapshots(
    task: Task, rollouts: Mapping[str, Rollout], times: Sequence[float] | Array, draw: Drawing | None = None
) -> Figure:
    """A row of pictures for every named rollout, a column for every time in s; one scale for all.

    A rollout that has failed by a column's time is shown there, pale, at the frame at which it failed, with
    the time and the failure in words; after that its row is empty.

    Raises
    ------
    NoPictureError
        If the task has no drawing and none is given.
    """
    draw = draw or drawing_of(task)
    if draw is None:
        raise NoPictureError(f"nothing draws {type(task).__name__}: pass `draw`")
    figure = Figure(
        figsize=(1.6 * len(times), 1.6 * len(rollouts) + 0.3), layout=ConstrainedLayoutEngine(h_pad=0.08)
    )
    grid = figure.subplots(len(rollouts), len(times), squeeze=False)
    for row, (name, rollout) in zip(grid, rollouts.items(), strict=True):
        failing = draw_strip(row, task, rollout, times, draw)
        row[0].text(-0.02, 0.5, name, transform=row[0].transAxes, rotation=90, ha="right", va="center")
        if failing is not None:
            words = fill(ending_words(task, rollout), 22)
            below = failing.transAxes
            failing.text(0.5, -0.03, words, transform=below, ha="center", va="top", fontsize=SMALL)
    for axes, time in zip(grid[0], times, strict=True):
        axes.set_title(f"t = {time:g} s", fontsize="medium")
    share_view(list(grid.flat))
    return figure


def ending_words(task: Task, rollout: Rollout) -> str:
    """When and why a rollout failed."""
    why = f": {task.words(rollout.failure)}" if rollout.failure else ""
    return f"{seconds(task, rollout.frames):.2f} s{why}"


def draw_strip(
    row: Sequence[Axes],
    task: Task,
    rollout: Rollout,
    times: Sequence[float] | Array,
    draw: Drawing,
    color: str = HARDWARE,
) -> Axes | None:
    """Draw a rollout at the times (s) into a row of axes; return those that show its failure, if any do.

    Set their view afterwards, with `share_view`.
    """
    failing = None
    for axes, time in zip(row, times, strict=True):
        axes.axis("off")
        if failing is not None:
            continue
        frame = round(time / task.time_step)
        failed = rollout.failed_at is not None and frame >= rollout.failed_at
        draw(axes, task, rollout.states[min(frame, rollout.frames)], color=color, muted=failed)
        failing = axes if failed else None
    return failing
