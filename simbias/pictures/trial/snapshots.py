"""Snapshots of rollouts (Fig. 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from simbias.core import Task
from simbias.core.records import Array, Rollout
from simbias.pictures.elements.drawing import Drawing, NoPictureError, drawing_of, share_view
from simbias.pictures.elements.style import HARDWARE, SIMULATION, SMALL, seconds
from simbias.pictures.trial.comparison import NamedRollout

LINE = 22  # characters below a snapshot
SIZE = 1.6  # in, of a snapshot


def snapshots(
    task: Task, rollouts: Mapping[str, Rollout], times: Sequence[float] | Array, draw: Drawing | None = None
) -> Figure:
    """A row of snapshots for every named rollout, a column for every time in s; one scale for all.

    Hardware, recognised by sensor readings, is orange as in all pictures, and simulation is blue. If a
    rollout has failed by a column's time, it is shown there pale, at the frame of the failure, with the time
    and the failure in words; the rest of its row is empty.

    Raises
    ------
    NoPictureError
        If the task has no drawing and none is given.
    """
    draw = draw or drawing_of(task)
    if draw is None:
        raise NoPictureError(f"nothing draws {type(task).__name__}: pass `draw`")
    figure = Figure(figsize=(SIZE * len(times), SIZE * len(rollouts) + 0.3), layout="constrained")
    colored = [
        NamedRollout(name, each, SIMULATION if each.measured is None and not each.sensed else HARDWARE)
        for name, each in rollouts.items()
    ]
    draw_rows(figure, task, colored, times, draw)
    share_view(figure.axes)
    return figure


def draw_rows(
    figure: FigureBase,
    task: Task,
    rollouts: Sequence[NamedRollout],
    times: Sequence[float] | Array,
    draw: Drawing,
) -> None:
    """Draw rollouts into rows below their times (s); set their view afterwards with `share_view`."""
    grid = figure.subplots(len(rollouts), len(times), squeeze=False)
    for row, (name, rollout, color, _) in zip(grid, rollouts, strict=True):
        failing = draw_strip(row, task, rollout, times, draw, color)
        _write(row[0], name, (-0.02, 0.5), rotation=90, ha="right", va="center", color=color)
        if failing is not None:
            words = fill(ending_words(task, rollout), LINE)
            _write(failing, words, (0.5, -0.03), ha="center", va="top", color=color)
    for axes, time in zip(grid[0], times, strict=True):
        axes.set_title(f"{time:g} s", fontsize=SMALL)


def _write(axes: Axes, words: str, place: tuple[float, float], **style: str | float) -> None:
    """Write words at a place in units of the axes."""
    axes.text(*place, words, transform=axes.transAxes, fontsize=SMALL, **style)  # type: ignore[arg-type]


def ending_words(task: Task, rollout: Rollout) -> str:
    """When and why a rollout failed, in words."""
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
    """Draw a rollout at the times (s) into a row of axes; return the axes that show its failure, if any.

    Set their view afterwards with `share_view`.
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
