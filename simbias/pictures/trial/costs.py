"""What simulation promised, and what hardware gave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from simbias.core.records import Iteration
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.panels import headline, legend, panels
from simbias.pictures.elements.style import (
    BEYOND,
    HARDWARE,
    LIMIT,
    SIMULATION,
    SMALL,
    logarithmic,
    plain,
    shade_beyond,
)
from simbias.pictures.trial.comparison import search_bias, search_nominal, simulate
from simbias.trial.study import Study

HEIGHT, APART = 2.4, 0.16  # in, of a panel; iterations, between experiments


def costs(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """The cost Z (Eq. 8) of each policy, predicted and measured.

    At the left, by iteration: the prediction that the policy was chosen by, each hardware experiment's cost,
    and, joined to it, that of its policy from the same start in the simulation of the iteration's search.
    At the right, these pairs, numbered by iteration; what lies above the diagonal is dearer than simulated.
    Z_max parts what works from what fails; shaded is what works in simulation and fails on hardware.

    Raises
    ------
    NoPictureError
        If no policy was searched in simulation.
    """
    if all(search_bias(iteration) is None for iteration in iterations):
        raise NoPictureError("no policy was searched in simulation")
    figure, grid = panels(1, 2, HEIGHT)
    (by_iteration, pairs), limit = grid[0], study.cost.max_cost
    values = [limit]
    for iteration in iterations:
        on_hardware, bias = [rollout.cost for rollout in iteration.experiments], search_bias(iteration)
        at = iteration.index + APART * (np.arange(len(on_hardware)) - (len(on_hardware) - 1) / 2)
        by_iteration.plot(at, on_hardware, "o", color=HARDWARE, zorder=3)
        values += on_hardware
        if iteration.search is not None:
            sides = [iteration.index - 0.35, iteration.index + 0.35]
            predicted_cost = iteration.search.predicted_cost
            by_iteration.plot(sides, [predicted_cost] * 2, color=SIMULATION, linewidth=2.5)
            values.append(predicted_cost)
        if bias is not None and on_hardware:
            models = [
                rollout.cost
                for rollout in simulate(study, bias, iteration.experiments, search_nominal(iteration))
            ]
            by_iteration.vlines(at, models, on_hardware, color="0.7", linewidth=0.8, zorder=1)
            by_iteration.plot(at, models, "o", color=SIMULATION, markerfacecolor="none", zorder=4)
            pairs.plot(models, on_hardware, "o", color=HARDWARE)
            _number(pairs, iteration.index, models, on_hardware)
            values += models
    if 0 < 10 * min(values) < max(values):
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


def _number(axes: Axes, index: int, models: Sequence[float], on_hardware: Sequence[float]) -> None:
    """Write the number of an iteration beside its pairs."""
    for pair in zip(models, on_hardware, strict=True):
        axes.annotate(str(index), pair, (4, 3), textcoords="offset points", fontsize=SMALL, color=LIMIT)


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
        "predicted by the search": Line2D([], [], color=SIMULATION, linewidth=2.5),
        "simulated, from an experiment's start": Line2D(
            [], [], color=SIMULATION, marker="o", linestyle="", markerfacecolor="none"
        ),
        "measured on hardware": Line2D([], [], color=HARDWARE, marker="o", linestyle=""),
    }
