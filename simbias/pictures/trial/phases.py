"""Phase portraits: each state against its rate, on hardware and in simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from simbias.core import Task, rate_pairs
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import BEYOND, HARDWARE, LIMIT, SIMULATION, label, plain
from simbias.pictures.trial.comparison import (
    compared_words,
    first_and_last,
    on_hardware,
    policy_experiments,
    simulated,
)
from simbias.trial.study import Study

HEIGHT = 2.3  # in, of a panel
LONG = 5  # letters of a tick's number, from which fewer ticks fit
NEAR = 0.5  # of a limit: a rollout that comes this close is shown with the limit


def phases(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """All experiments of the first and the last policy, in the planes of a state and its rate.

    Each is shown with its simulation from the policy's search, if any, from the same start (a dot). A cross
    marks a failure. Shaded areas are forbidden by a criterion for a single state or rate
    (`Criterion.bounds`). Failures may also lie elsewhere, as a criterion may combine several states.

    Raises
    ------
    NoPictureError
        If no state is the rate of another by its unit, or no policy was tried on the hardware.
    """
    task, pairs = study.task, rate_pairs(study.task.without_targets.states)
    if not pairs:
        raise NoPictureError(f"no state of {type(task).__name__} has another's unit per second")
    both = first_and_last(on_hardware(iterations))
    figure, blocks = panels(len(pairs), HEIGHT, blocks=len(both))
    rollouts: list[Rollout] = []
    for block, iteration in zip(blocks, both, strict=True):
        headline(block[0], compared_words(study, iteration))
        experiments = policy_experiments(iteration)
        models = simulated(study, iteration, experiments)
        for axes, pair in zip(block, pairs, strict=True):
            _draw(axes, task, pair, models, SIMULATION, "--")
            _draw(axes, task, pair, experiments, HARDWARE, "-")
        rollouts += [*experiments, *models]
    bounds = state_bounds(task)
    for index, pair in enumerate(pairs):
        _share_view(list(blocks[:, index]), bounds[list(pair)])
    simulates = any(iteration.model is not None for iteration in both)
    fails = any(rollout.failed_at is not None for rollout in rollouts)
    legend(figure, _entries(simulates, fails, any(axes.patches for axes in blocks.flat)))
    return figure


def state_bounds(task: Task) -> Array:
    """The largest |x| (n,) that criteria allow for each state alone; infinite if unlimited."""
    return np.array(
        [
            min((criterion.bounds.get(state.name, np.inf) for criterion in task.criteria), default=np.inf)
            for state in task.states
        ]
    )


def _draw(
    axes: Axes, task: Task, pair: tuple[int, int], rollouts: Sequence[Rollout], color: str, line: str
) -> None:
    """Draw rollouts in the plane of two states, each with its start and its failure."""
    for rollout in rollouts:
        x, y = rollout.states[:, pair].T
        axes.plot(x, y, line, color=color, linewidth=0.9)
        axes.plot(x[0], y[0], "o", color="black", markersize=3.5, zorder=4)
        if rollout.failed_at is not None:
            axes.plot(x[-1], y[-1], "X", color=color, markersize=8, markeredgecolor="white", zorder=3)
    axes.set(xlabel=label(task.states[pair[0]]), ylabel=label(task.states[pair[1]]))
    plain(axes)


def _share_view(all_axes: Sequence[Axes], bounds: Array) -> None:
    """Set one view for all panels of a plane, including those bounds (2,) that a rollout approaches."""
    corners = np.concatenate([axes.dataLim.get_points() for axes in all_axes])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.06 * np.where(high > low, high - low, 1.0)  # of a state that never changes
    low = np.where(low < -NEAR * bounds, np.minimum(low, -bounds), low) - margin
    high = np.where(high > NEAR * bounds, np.maximum(high, bounds), high) + margin
    for axes in all_axes:
        shades: Any = axes.axvspan, axes.axhspan
        ticks = MaxNLocator(5).tick_values(low[0], high[0])
        axes.locator_params("x", nbins=5 if max(len(f"{tick:.6g}") for tick in ticks) < LONG else 3)
        for shade, least, most, bound in zip(shades, low, high, bounds, strict=True):
            for edges in ((least, -bound), (bound, most)):
                if edges[0] < edges[1]:
                    shade(*edges, color=BEYOND, linewidth=0.0, zorder=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _entries(simulates: bool, fails: bool, shaded: bool) -> dict[str, Artist]:
    """The legend of the elements shown."""
    failure = Line2D([], [], color=LIMIT, marker="X", linestyle="", markeredgecolor="white")
    return {
        "start": Line2D([], [], color="black", marker="o", markersize=3.5, linestyle=""),
        "hardware": Line2D([], [], color=HARDWARE),
        **({"simulation": Line2D([], [], color=SIMULATION, linestyle="--")} if simulates else {}),
        **({"failure": failure} if fails else {}),
        **({"beyond a limit": Patch(color=BEYOND)} if shaded else {}),
    }
