"""Pictures of an assessment: parameters, errors by horizon, predictions against measurements."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from simbias.core import Quantity
from simbias.core.records import Array
from simbias.pictures.elements.layout import legend, panels
from simbias.pictures.elements.style import (
    HARDWARE,
    NOMINAL,
    SIMULATION,
    SMALL,
    literal,
    logarithmic,
    plain,
    with_unit,
)
from simbias.recordings.assessment import Assessment
from simbias.recordings.findings import Finding
from simbias.simulation.open_loop import PredictionModel, Windows, predict

COLUMNS = 4  # of parameters, and of states
SECONDS = 1.0  # of each drawn prediction
DRAWN = 5  # s of a part, at most
MEASURED: Any = {"color": HARDWARE, "linewidth": 4.0, "alpha": 0.35}  # visible below a correct prediction
PRIOR = "0.75"  # grey
WIDER = 1.0  # margin around prior and posterior, relative to their interval, for other estimates
NARROW = 0.1  # of the prior's width: narrower estimates are drawn without the prior's ends
LONG = 26  # characters of a name with its unit; beyond, the unit gets its own line
CLEAR = 6.0  # times the measured range: predictions beyond are not drawn


def parameters(assessment: Assessment) -> Figure:
    """Prior and posterior of each parameter, from 5% to 95%, and its estimates from each part alone.

    The posterior is always shown whole. An interval that extends beyond the axes ends in an arrow.
    """
    found = assessment.findings
    figure, (grid,) = panels(len(found), 0.8, COLUMNS)
    between = "\n" if max(len(f"{each.prior.name}{each.prior.unit}") for each in found) > LONG else " "
    for axes, finding in zip(grid, found, strict=True):
        _parameter(axes, finding)
        axes.set_title(f"{finding.prior.name}{between}({finding.prior.unit})", fontsize=SMALL)
    alone = f"alone, from top to bottom: {', '.join(literal(part.name) for part in assessment.parts)}"
    shown = {
        "prior, 5% to 95%": Line2D([], [], color=PRIOR, linewidth=3.0),
        "posterior": Line2D([], [], color=SIMULATION, linewidth=3.0),
        alone: Line2D([], [], color=HARDWARE, linewidth=1.2),
    }
    legend(figure, shown)
    return figure


def _parameter(axes: Axes, finding: Finding) -> None:
    """The intervals of a parameter, one below the other."""
    one = finding.estimate
    rows: list[tuple[float, float, float, float | None, str, float, str]] = [
        (0.0, *finding.prior_interval, None, PRIOR, 4.0, ""),
        (1.0, one.low, one.high, one.value, SIMULATION, 4.0, "o"),
    ]
    for i, each in enumerate(finding.by_part):
        rows.append((2 + 0.5 * i, each.low, each.high, each.value, HARDWARE, 1.2, "s"))
    left, right = _view(finding)
    for y, low, high, value, color, width, marker in rows:
        axes.plot(np.clip([low, high], left, right), [y, y], color=color, linewidth=width)
        for beyond, edge, arrow in ((low < left, left, "<"), (high > right, right, ">")):
            if beyond:
                axes.plot(edge, y, arrow, color=color, markersize=4 + width, clip_on=False)
        if value is not None and left <= value <= right:
            axes.plot(value, y, marker, color=color, markersize=4, markeredgecolor="white")
    axes.set_ylim(2.5 + 0.5 * len(finding.by_part), -0.5)
    axes.set_yticks([])
    axes.locator_params(axis="x", nbins=3)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.tick_params(labelsize=SMALL)
    axes.spines[["left"]].set_visible(False)
    plain(axes)


def _view(finding: Finding) -> tuple[float, float]:
    """The drawn interval of a parameter, with a margin.

    It spans prior and posterior or, if estimates are far narrower than the prior, the estimates.
    """
    low, high = finding.prior_interval
    estimates = [finding.estimate, *finding.by_part]
    lowest, highest = min(each.low for each in estimates), max(each.high for each in estimates)
    if highest - lowest < NARROW * (high - low):
        low, high = lowest, highest
    low, high = min(low, finding.estimate.low), max(high, finding.estimate.high)
    room = WIDER * (high - low)
    return low - room, high + room


def errors(assessment: Assessment) -> Figure:
    """Root mean square errors of each state, by prediction horizon."""
    task, made = assessment.task, assessment.predictions
    figure, (grid,) = panels(len(task.states), 1.8, COLUMNS)
    seconds = [prediction.seconds for prediction in made]
    both = np.array([prediction.rmse() for prediction in made])  # (horizons, 2, n)
    for i, (axes, state) in enumerate(zip(grid, task.states, strict=True)):
        for values, color, marker in ((both[:, 0, i], NOMINAL, "s"), (both[:, 1, i], SIMULATION, "o")):
            shown = np.where(np.isfinite(values) & (values > 0), values, np.nan)
            axes.plot(seconds, shown, color=color, marker=marker, markersize=4)
        axes.set_title(_label(state), fontsize=SMALL)
        axes.set_xlabel("horizon (s)")
        logarithmic(axes.xaxis)
        if np.nanmin(both[:, :, i]) > 0:
            logarithmic(axes.yaxis)
        axes.set_xticks([0.1, 1.0], ["0.1", "1"])
        plain(axes)
    legend(figure, {"nominal model": _line(NOMINAL), "identified model": _line(SIMULATION)})
    return figure


def forecasts(assessment: Assessment, index: int) -> Figure:
    """A judged part as measured and as predicted by both models, from the measured state each second."""
    task, part = assessment.task, assessment.judged[index]
    rollout = max(part.rollouts, key=lambda each: each.frames)
    window = min(task.frames(SECONDS), rollout.frames)
    frames = min(task.frames(DRAWN), rollout.frames) // window * window
    rollout = rollout.part(0, frames)
    windows = Windows.of([rollout], window, 1)
    models = [assessment.nominal, assessment.models[index]]
    made = [predict([PredictionModel(model)], windows)[0] for model in models]
    figure, (grid,) = panels(len(task.states), 1.1, 1)
    t = task.time_step * np.arange(frames + 1)
    for i, (axes, state) in enumerate(zip(grid, task.states, strict=True)):
        measured = rollout.states[:, i]
        axes.plot(t, measured, **MEASURED)
        for values, color in zip(made, (NOMINAL, SIMULATION), strict=True):
            for start, own in zip(range(0, frames, window), values[:, :, i], strict=True):
                shown = np.concatenate([[measured[start]], _clear(own, measured)])
                axes.plot(t[start : start + window + 1], shown, color=color, linewidth=1.0)
        axes.set_ylabel(_label(state), fontsize=SMALL)
        plain(axes)
    grid[-1].set_xlabel("time (s)")
    entries = {"nominal model": NOMINAL, "identified model": SIMULATION}
    lines = {name: Line2D([], [], color=color, linewidth=1.0) for name, color in entries.items()}
    legend(figure, {"measured": Line2D([], [], **MEASURED), **lines})
    return figure


def _clear(predicted: Array, measured: Array) -> Array:
    """A prediction (k,), with nan far outside the measured range."""
    low, high = measured.min(), measured.max()
    room = CLEAR * (high - low) + 1e-9
    return np.where((predicted > low - room) & (predicted < high + room), predicted, np.nan)


def _label(state: Quantity) -> str:
    """The name and unit of a state, as in tables."""
    return with_unit(literal(state.name), state.unit)


def _line(color: str) -> Line2D:
    """The legend's entry of a model."""
    return Line2D([], [], color=color, marker="o" if color == SIMULATION else "s", markersize=4)
