"""Costs predicted in simulation and measured on hardware."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from simbias.core.records import Iteration
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import (
    BEYOND,
    HARDWARE,
    LIMIT,
    SIMULATION,
    SMALL,
    logarithmic_if_wide,
    plain,
    shade_beyond,
    whole_numbers,
)
from simbias.pictures.trial.comparison import cost_limit, cost_markers, simulated
from simbias.trial.study import Study

HEIGHT = 2.6  # in, of a panel
ASIDE = 0.16  # in iterations, offset between experiments of one iteration
PALEST = 0.9  # share of white in the face of the first iteration's pairs
SEARCHED = "predicted by the search, from its own starts"
LEGEND = {
    SEARCHED: Line2D([], [], color=SIMULATION, linewidth=2.5),
    "simulated, from the experiment's start": Line2D(
        [], [], color=SIMULATION, marker="o", linestyle="", markerfacecolor="none"
    ),
    "measured on hardware": Line2D([], [], color=HARDWARE, marker="o", linestyle=""),
}
ALONE = "works in simulation alone"
NO_SUCCESS = {"no success": Line2D([], [], color=HARDWARE, marker="X", linestyle="")}


def costs(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """The cost Z (Eq. 8) of each policy, predicted and measured.

    Left, by iteration: the prediction that selected the policy, each hardware experiment's cost and,
    connected to it, the cost of the policy from the same start in the simulation of the iteration's search.
    Right: these pairs, darker for later iterations; a pair above the diagonal costs more than simulated.
    Z_max separates success from failure; the shaded area is below it in simulation and above it on hardware.
    Crosses are unsuccessful experiments that cost less than Z_max, for example because they fail in their
    last frame; if the task itself decides success, all unsuccessful ones.

    Raises
    ------
    NoPictureError
        If no policy was made in simulation.
    """
    if all(iteration.model is None for iteration in iterations):
        raise NoPictureError("no policy was searched in simulation")
    figure, grid = panels(2, HEIGHT)
    (by_iteration, pairs), limit = grid[0], cost_limit(study)
    values, crosses = [limit], {}
    for iteration in iterations:
        measured = np.array([rollout.cost for rollout in iteration.experiments])
        models = np.array([each.cost for each in simulated(study, iteration, iteration.experiments)])
        at = iteration.index + ASIDE * (np.arange(len(measured)) - (len(measured) - 1) / 2)
        markers = dict(cost_markers(study, iteration.experiments))
        for marker, some in markers.items():
            by_iteration.plot(at[some], measured[some], marker, color=HARDWARE, zorder=3)
        if "X" in markers:
            crosses = NO_SUCCESS
        if iteration.search is not None:
            sides = [iteration.index - 0.35, iteration.index + 0.35]
            by_iteration.plot(sides, [iteration.search.predicted_cost] * 2, color=SIMULATION, linewidth=2.5)
            values.append(iteration.search.predicted_cost)
        if len(models):
            by_iteration.vlines(at, models, measured, color="0.7", linewidth=0.8, zorder=1)
            by_iteration.plot(at, models, "o", color=SIMULATION, markerfacecolor="none", zorder=4)
            age = (iterations[-1].index - iteration.index) / max(1, iterations[-1].index)
            face = 1 - (1 - PALEST * age) * (1 - np.array(to_rgb(HARDWARE)))
            style = {"color": HARDWARE, "markerfacecolor": face, "markeredgewidth": 0.5}
            for marker, some in markers.items():
                pairs.plot(models[some], measured[some], marker, **style)
        values += [*measured, *models]
    logarithmic_if_wide(values, by_iteration.yaxis, pairs.xaxis, pairs.yaxis)
    by_iteration.set_xlim(-0.5, max(iteration.index for iteration in iterations) + 0.5)
    whole_numbers(by_iteration.xaxis)
    by_iteration.set(xlabel="iteration", ylabel="cost Z (dimensionless)")
    shade_beyond(by_iteration, limit, r"limit $Z_{\max}$")
    _divide(pairs, limit, values[1:])
    headline(by_iteration, "Predicted and measured cost of each policy")
    headline(pairs, "Each experiment: darker ones are later")
    for axes in (by_iteration, pairs):
        plain(axes)
    searched = any(iteration.search is not None for iteration in iterations)
    entries = {name: line for name, line in LEGEND.items() if searched or name != SEARCHED}
    legend(figure, entries | crosses)
    return figure


def _divide(axes: Axes, limit: float, costs: Sequence[float]) -> None:
    """Draw the diagonal, and separate success from failure if there is a limit; else show all costs."""
    finite = [cost for cost in costs if np.isfinite(cost)] or [1.0]
    ends = (limit / 2, 2 * limit) if np.isfinite(limit) else (min(finite), max(finite))
    axes.update_datalim([(end, end) for end in ends])
    axes.autoscale_view()
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    both = [max(left, bottom), min(right, top)]
    axes.plot(both, both, color=LIMIT, linewidth=0.8, linestyle=":", zorder=1)
    if np.isfinite(limit):
        axes.axhline(limit, color=LIMIT, linewidth=0.8, zorder=1)
        axes.axvline(limit, color=LIMIT, linewidth=0.8, zorder=1)
        axes.fill_between([left, limit], limit, top, color=BEYOND, linewidth=0.0, zorder=0)
        axes.annotate(
            ALONE, (left, limit), (3, 4), textcoords="offset points", color=LIMIT, fontsize=SMALL, zorder=0.5
        )
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_xlabel("Z in simulation, from the same start (dimensionless)")
    axes.set_ylabel("Z on hardware (dimensionless)")
