"""What simulation promised, and what hardware gave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from simbias.pictures.panels import headline, legend, panels
from simbias.pictures.style import (
    BEYOND,
    HARDWARE,
    LIMIT,
    SIMULATION,
    SMALL,
    logarithmic,
    plain,
    shade_beyond,
)
from simbias.pictures.trial.compared import simulated
from simbias.records import Iteration
from simbias.study import Study

HEIGHT, APART = 2.4, 0.16  # in, of a panel; iterations, between experiments


def costs(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """The cost Z (Eq. 8) of each policy, predicted and measured.

    At the left, by iteration: the prediction that the policy was chosen by, each hardware experiment's cost,
    and, joined to it, that of the same policy from the same start in the simulation that it was optimised in.
    At the right, these pairs, numbered by iteration; what lies above the diagonal is dearer than simulated.
    Z_max parts what works from what fails; shaded is what works in simulation and fails on hardware.
    """
    figure, grid = panels(1, 2, HEIGHT)
    (by_iteration, pairs), limit = grid[0], study.cost.max_cost
    seen = [limit]
    for iteration in iterations:
        models = [rollout.cost for rollout in simulated(study, iteration)]
        measured = [rollout.cost for rollout in iteration.experiments]
        at = iteration.index + APART * (np.arange(len(measured)) - (len(measured) - 1) / 2)
        sides = [iteration.index - 0.35, iteration.index + 0.35]
        by_iteration.plot(sides, [iteration.predicted_cost] * 2, color=SIMULATION, linewidth=2.5)
        by_iteration.vlines(at, models, measured, color="0.7", linewidth=0.8, zorder=1)
        by_iteration.plot(at, models, "o", color=SIMULATION, markerfacecolor="white")
        by_iteration.plot(at, measured, "o", color=HARDWARE)
        pairs.plot(models, measured, "o", color=HARDWARE)
        for x, y in zip(models, measured, strict=True):
            pairs.annotate(
                str(iteration.index), (x, y), (4, 3), textcoords="offset points", fontsize=SMALL, color=LIMIT
            )
        seen += [iteration.predicted_cost, *models, *measured]
    if 0 < 10 * min(seen) < max(seen):
        logarithmic(by_iteration, "y")
        logarithmic(pairs, "x", "y")
    by_iteration.xaxis.set_major_locator(MaxNLocator(integer=True))
    by_iteration.set_xlabel("iteration", labelpad=1)
    by_iteration.set_ylabel("cost Z (dimensionless)", labelpad=1)
    shade_beyond(by_iteration, limit, r"limit $Z_{\max}$")
    _part(pairs, limit)
    headline(by_iteration, "Predicted and measured cost of each policy")
    headline(pairs, "Each experiment and its simulation")
    for axes in (by_iteration, pairs):
        plain(axes)
    legend(figure, _entries())
    return figure


def _part(axes: Axes, limit: float) -> None:
    """Draw the diagonal, and part what works from what fails."""
    (left, right), (bottom, top) = (
        (min(*view, limit / 2), max(*view, 2 * limit)) for view in (axes.get_xlim(), axes.get_ylim())
    )
    both = [max(left, bottom), min(right, top)]
    axes.plot(both, both, color=LIMIT, linewidth=0.8, linestyle=":", zorder=1)
    axes.axhline(limit, color=LIMIT, linewidth=0.8, zorder=1)
    axes.axvline(limit, color=LIMIT, linewidth=0.8, zorder=1)
    axes.fill_between([left, limit], limit, top, color=BEYOND, linewidth=0.0, zorder=0)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_xlabel("Z in simulation, from the same start (dimensionless)", labelpad=1)
    axes.set_ylabel("Z on hardware (dimensionless)", labelpad=1)


def _entries() -> dict[str, Line2D]:
    """What is seen."""
    return {
        "predicted, from the mean start": Line2D([], [], color=SIMULATION, linewidth=2.5),
        "simulated, from an experiment's start": Line2D(
            [], [], color=SIMULATION, marker="o", linestyle="", markerfacecolor="white"
        ),
        "measured on hardware": Line2D([], [], color=HARDWARE, marker="o", linestyle=""),
    }
