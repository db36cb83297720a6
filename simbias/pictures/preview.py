"""The prediction of an experiment before it is run, with a band."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from simbias.core import Quantity, Task
from simbias.core.records import Array
from simbias.lab.safety import Bounds, exceeded
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import LIMIT, SIMULATION, label, plain
from simbias.trial.prediction import DRAWS, Prediction
from simbias.trial.study import Study

HEIGHT = 1.5  # in, of a panel
WIDEST = 5.0  # times the predicted range: farther, the band leaves the axes


class Series(NamedTuple):
    """A state or an input over time, as predicted."""

    quantity: Quantity
    expected: Array  # (T,)
    low: Array  # (T,) of the band
    high: Array
    limits: Sequence[float]  # below and above


def predicted(task: Task, prediction: Prediction, bounds: Bounds) -> Iterator[Series]:
    """The states, if they can be predicted, then the inputs, as series."""
    expected = prediction.expected
    states = (task.states, expected.states, prediction.band(), (-bounds.states, bounds.states))
    inputs = (task.inputs, expected.inputs, prediction.band(inputs=True), bounds.input_bounds)
    for quantities, values, band, limits in (states, inputs) if prediction.is_known else (inputs,):
        for index, quantity in enumerate(quantities):
            low, high = (edge[:, index] for edge in band)
            yield Series(quantity, values[:, index], low, high, [limit[index] for limit in limits])


def preview(study: Study, prediction: Prediction, bounds: Bounds) -> Figure:
    """Every state and input over time in s; dotted lines are the limits that abort the experiment."""
    task, limited = study.task, False
    shown = list(predicted(task, prediction, bounds))
    figure, (grid,) = panels(len(shown), HEIGHT)
    for axes, series in zip(grid, shown, strict=True):
        limited |= _draw(axes, task.time_step, series)
    ended = [d.failed_at is not None or exceeded(d, task, bounds) != "" for d in prediction.draws]
    headline(grid[0], "the next experiment, as predicted")
    entries: dict[str, Artist] = {
        "from the experiment's start": Line2D([], [], color=SIMULATION),
        f"at each time, 90% of {DRAWS} draws of {prediction.drawn}"
        f"{f', {sum(ended)} fail or are aborted' if any(ended) else ''}": Patch(color=SIMULATION, alpha=0.2),
    }
    if limited:
        entries["limit"] = Line2D([], [], color=LIMIT, linestyle=":")
    legend(figure, entries)
    return figure


def _draw(axes: Axes, time_step: float, series: Series) -> bool:
    """Draw a quantity over time, its band, and its limits; return whether a limit is near."""
    quantity, values, low, high, limits = series
    axes.fill_between(time_step * np.arange(len(low)), low, high, color=SIMULATION, alpha=0.2, linewidth=0.0)
    axes.plot(time_step * np.arange(len(values)), values, color=SIMULATION, linewidth=1.0)
    (bottom, top), least, most = axes.get_ylim(), np.nanmin(values), np.nanmax(values)
    far = WIDEST * (most - least) or np.inf  # draws may diverge
    bottom, top = axes.set_ylim(max(bottom, least - far), min(top, most + far))
    near = [edge for edge in limits if 2 * bottom - top <= edge <= 2 * top - bottom]
    for edge in near:
        axes.axhline(edge, color=LIMIT, linestyle=":", linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel=label(quantity))
    plain(axes)
    return bool(near)
