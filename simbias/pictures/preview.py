"""The prediction of an experiment before it is made, with a band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from simbias.core import Quantity
from simbias.core.records import Array
from simbias.lab.safety import Bounds
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import LIMIT, SIMULATION, label, plain
from simbias.trial.prediction import DRAWS, Prediction
from simbias.trial.study import Study

HEIGHT = 1.5  # in, of a panel


def preview(study: Study, prediction: Prediction, bounds: Bounds) -> Figure:
    """Every state and input over time in s; dotted, the limits at which the experiment is aborted."""
    task, expected = study.task, prediction.expected
    figure, (grid,) = panels(len(task.states) + len(task.inputs), HEIGHT)
    empty, limited = iter(grid), False
    for quantities, values, band, limits in (
        (task.states, expected.states, prediction.band(), (-bounds.states, bounds.states)),
        (task.inputs, expected.inputs, prediction.band(inputs=True), bounds.input_bounds),
    ):
        for index, quantity in enumerate(quantities):
            low, high = (edge[:, index] for edge in band)
            edges = [limit[index] for limit in limits]
            limited |= _draw(next(empty), quantity, task.time_step, values[:, index], low, high, edges)
    fail = len(prediction.failures)
    headline(grid[0], "the next experiment, as predicted")
    entries: dict[str, Artist] = {
        "from the experiment's start": Line2D([], [], color=SIMULATION),
        f"90 % of {DRAWS} draws of other starts and models{f', {fail} fail' if fail else ''}": Patch(
            color=SIMULATION, alpha=0.2
        ),
    }
    if limited:
        entries["limit"] = Line2D([], [], color=LIMIT, linestyle=":")
    legend(figure, entries)
    return figure


def _draw(
    axes: Axes,
    quantity: Quantity,
    time_step: float,
    values: Array,
    low: Array,
    high: Array,
    limits: Sequence[float],
) -> bool:
    """A quantity over time, its band from low to high, and its limits; whether one of them is near."""
    axes.fill_between(time_step * np.arange(len(low)), low, high, color=SIMULATION, alpha=0.2, linewidth=0.0)
    axes.plot(time_step * np.arange(len(values)), values, color=SIMULATION, linewidth=1.0)
    bottom, top = axes.get_ylim()
    near = [edge for edge in limits if 2 * bottom - top <= edge <= 2 * top - bottom]
    for edge in near:
        axes.axhline(edge, color=LIMIT, linestyle=":", linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel=label(quantity))
    plain(axes)
    return bool(near)
