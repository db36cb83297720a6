"""The reference of a moving goal, beside the rollouts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from simbias.core import Task
from simbias.core.quantities import wrapped
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import HARDWARE, SIMULATION, label, plain
from simbias.pictures.trial.comparison import (
    compared_words,
    first_and_last,
    on_hardware,
    simulated,
    worst_experiment,
)
from simbias.trial.study import Study

HEIGHT = 2.3  # in, of a panel
REFERENCE = "0.6"  # grey
LEGEND = {
    "reference": Line2D([], [], color=REFERENCE, linewidth=3.0),
    "hardware": Line2D([], [], color=HARDWARE),
    "simulation of its search": Line2D([], [], color=SIMULATION, linestyle="--"),
}


def following(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """Each goal quantity over time with its reference, for the first and the last policy.

    Two quantities in one unit are first shown against each other. For each policy, the worst experiment is
    shown and, from the same start, the simulation used in its search. A cross marks a rollout's failure.

    Raises
    ------
    NoPictureError
        If the goal does not move, or no policy was tried on the hardware.
    """
    task, times = study.task, study.task.time_step * np.arange(study.task.horizon + 1)
    if not np.diff([task.reference(t) for t in times], axis=0).any():
        raise NoPictureError("the goal does not move")
    both = first_and_last(on_hardware(iterations))
    in_plane = len(task.goals) == 2 and task.goals[0].unit == task.goals[1].unit
    figure, blocks = panels(len(task.goals) + in_plane, HEIGHT, blocks=len(both))
    for block, iteration in zip(blocks, both, strict=True):
        headline(block[0], compared_words(study, iteration))
        experiment = worst_experiment(study, iteration)
        targets = [task.targets_in(experiment.states[0])] if task.targets else []
        reference = np.array([task.reference(t, *targets) for t in times])  # (T+1, g)
        rollouts = [*simulated(study, iteration, [experiment]), experiment]
        shown = [(_near(task, each, reference[0]), each, each is experiment) for each in rollouts]
        if in_plane:
            _draw_plane(block[0], task, reference, shown)
        for goal, axes in enumerate(block[int(in_plane) :]):
            _draw_over_time(axes, task, goal, np.column_stack([times, reference[:, goal]]), shown)
    legend(figure, LEGEND)
    return figure


Shown = Sequence[tuple[Array, Rollout, bool]]  # the goal's quantities (k+1, g) of a rollout; on hardware?


def _near(task: Task, rollout: Rollout, first: Array) -> Array:
    """The goal's quantities (k+1, g); those that wrap begin within half a turn of their first reference."""
    values = task.aim(rollout.states)
    away = values[0] - first
    return values + (wrapped(away, task.goals) - away)


def _draw_plane(axes: Axes, task: Task, reference: Array, shown: Shown) -> None:
    """Draw both quantities against each other, to scale."""
    axes.plot(*reference.T, color=REFERENCE, linewidth=3.0)
    for each in shown:
        _draw(axes, *each)
    axes.set(xlabel=label(task.goals[0]), ylabel=label(task.goals[1]))
    axes.set_aspect("equal", adjustable="datalim")
    plain(axes)


def _draw_over_time(axes: Axes, task: Task, goal: int, reference: Array, shown: Shown) -> None:
    """Draw a quantity over time; the reference (T+1, 2) has times in its first column."""
    axes.plot(*reference.T, color=REFERENCE, linewidth=3.0)
    for values, rollout, is_real in shown:
        times = task.time_step * np.arange(rollout.frames + 1)
        _draw(axes, np.column_stack([times, values[:, goal]]), rollout, is_real)
    axes.set(xlabel="time (s)", ylabel=label(task.goals[goal]))
    plain(axes)


def _draw(axes: Axes, points: Array, rollout: Rollout, is_real: bool) -> None:
    """Draw a rollout's points (k, 2), and its failure."""
    color, line = (HARDWARE, "-") if is_real else (SIMULATION, "--")
    axes.plot(*points.T, line, color=color, linewidth=1.0)
    if rollout.failed_at is not None:
        axes.plot(*points[-1], "X", color=color, markersize=8, markeredgecolor="white", zorder=3)
