"""Prediction errors on experiments before they were used for learning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from threadpoolctl import threadpool_limits

from simbias.core import FittedBias, Nominal, Task
from simbias.core.messages import counted
from simbias.core.records import Array, Iteration
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.layout import legend, panels
from simbias.pictures.elements.style import (
    NOMINAL,
    SIMULATION,
    SMALL,
    SeriesStyle,
    logarithmic,
    plain,
    seconds,
    symbol,
    whole_numbers,
    with_unit,
)
from simbias.pictures.trial.comparison import learned_before
from simbias.simulation.open_loop import PredictionModel, Windows
from simbias.simulation.open_loop import plain as predict_in_numpy
from simbias.trial.study import Study

HORIZONS = (1, 5, 20, 100)  # frames
WINDOWS = 40  # maximum number in the experiments of an iteration
HEIGHT = 1.8  # in, of a panel
NAMES, LONG = 2, 14  # states per line of a label; letters of a name that gets its own line
NOMINAL_ALONE, CORRECTED = "nominal model alone", "with what had been learned before"
STYLES = {NOMINAL_ALONE: SeriesStyle(NOMINAL, "s"), CORRECTED: SeriesStyle(SIMULATION, "o")}
ASIDE = {NOMINAL_ALONE: -0.12, CORRECTED: 0.12}  # in iterations


def prediction_errors(
    study: Study, iterations: Sequence[Iteration], horizons: Sequence[int] = HORIZONS
) -> Figure:
    """Errors of predictions several frames ahead, in each iteration's experiments: medians and quartiles.

    Models were learned only from earlier iterations and from recordings; before that, there is only the
    nominal model. A prediction starts at the recorded state in one of several evenly spaced frames and
    applies the commanded inputs. Its error is the norm over all states that share a unit. Horizons (in
    frames) longer than a quarter of the task's or than every experiment are left out, and so are experiments
    shorter than the longest horizon.

    Raises
    ------
    NoPictureError
        If no experiment lasted as long as the shortest horizon.
    """
    frames = [rollout.frames for iteration in iterations for rollout in iteration.experiments]
    longest = min(max(1, study.task.horizon // 4), max(frames, default=0))
    horizons = [k for k in horizons if k <= longest]
    if not horizons:
        raise NoPictureError("no experiment lasted as long as the shortest horizon")
    groups = _groups(study.task)
    figure, grid = panels(len(horizons), HEIGHT, len(horizons), blocks=len(groups))
    shown: dict[str, Line2D] = {}
    by_iteration = [(each, _models(study, iterations, each)) for each in iterations]
    beside = len({name for _, models in by_iteration for name in models}) > 1
    for iteration, models in by_iteration:
        for name, (bias, nominal) in models.items():
            color, marker = STYLES[name]
            pieces = windows(study, iteration, max(horizons))
            if not len(pieces):
                continue  # its experiments ended too early
            errors = prediction_error(bias, nominal, pieces, horizons)
            if np.any(errors):  # otherwise a logarithmic scale would be empty
                entry = Line2D([], [], color=color, marker=marker, linewidth=2.5, markerfacecolor="white")
                shown[name] = entry
            for row, states in zip(grid, groups.values(), strict=True):
                for axes, values in zip(row, errors, strict=True):
                    norms = np.linalg.norm(values[:, states], axis=1)
                    _draw(axes, iteration.index + beside * ASIDE[name], norms, STYLES[name])
    for row, (unit, states) in zip(grid, groups.items(), strict=True):
        symbols = [symbol(study.task.states[i].name) for i in states]
        names = NAMES if max(map(len, symbols)) < LONG or "$" in symbols[0] else 1
        lines = [", ".join(symbols[i : i + names]) for i in range(0, len(symbols), names)]
        row[0].set_ylabel(with_unit("error of " + ",\n".join(lines), unit), fontsize=SMALL)
        _share_scale(row)
    for axes, k in zip(grid[0], horizons, strict=True):
        ahead = seconds(study.task, k)
        time = f"{1000 * ahead:g} ms" if ahead <= 1 else f"{ahead:g} s"
        axes.set_title(f"{counted(k, 'frame')} ahead ({time})", fontsize=SMALL)
    for axes in grid[-1]:
        axes.set_xlabel("iteration")
    for axes in grid.flat:
        axes.set_xlim(iterations[0].index - 0.5, iterations[-1].index + 0.5)
    legend(figure, shown | {"markers: medians, bars: quartiles": Line2D([], [], linestyle="none")})
    return figure


def _models(
    study: Study, iterations: Sequence[Iteration], iteration: Iteration
) -> dict[str, tuple[FittedBias, Nominal]]:
    """The biases and nominal models that predict an iteration's experiments, by name."""
    models = {NOMINAL_ALONE: (study.bias.fit(study.no_data), study.nominal)}
    model = iteration.model
    if model is not None and learned_before(iterations, iteration):
        models[CORRECTED] = model.bias, model.nominal
    return models


def windows(study: Study, iteration: Iteration, frames: int) -> Windows:
    """Windows of `frames` frames, evenly spaced over the experiments that are long enough."""
    experiments = study.of_robot(iteration.experiments)
    whole, most = Windows.of(experiments, 1, 1), max(1, WINDOWS // len(experiments))
    starts = [_spread(rollout.frames - frames, most) for rollout in experiments]
    leads = np.array([t for each in starts for t in each], np.int64)
    firsts = np.repeat(whole.firsts, [len(each) for each in starts]) + leads
    return replace(whole, firsts=firsts, leads=leads, frames=np.full(len(leads), frames), window=frames)


def _spread(last: int, most: int) -> list[int]:
    """At most `most` frames from 0 to the last, evenly spaced."""
    return sorted({round(t) for t in np.linspace(0, last, most)}) if last >= 0 else []


@threadpool_limits.wrap(limits=1, user_api="blas")
def prediction_error(bias: FittedBias, nominal: Nominal, pieces: Windows, horizons: Sequence[int]) -> Array:
    """Errors (horizons, w, n) of predictions (Eq. 7) from the first state of each piece, under its inputs."""
    errors = predict_in_numpy([PredictionModel(nominal)], pieces, bias)[0] - pieces.means
    return np.moveaxis(errors[:, np.array(horizons) - 1], 1, 0)


def _groups(task: Task) -> dict[str, list[int]]:
    """Indices of the states of each unit."""
    units = [quantity.unit for quantity in task.without_targets.states]
    return {unit: [i for i, other in enumerate(units) if other == unit] for unit in units}


def _draw(axes: Axes, x: float, values: Array, style: SeriesStyle) -> None:
    """Median and quartiles of the errors (w,) of an iteration."""
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    axes.plot([x, x], [low, high], color=style.color, linewidth=2.5, solid_capstyle="butt", zorder=3)
    axes.plot(x, median, style.marker, color=style.color, markersize=6, markerfacecolor="white")


def _share_scale(row: Sequence[Axes]) -> None:
    """Set one scale for a row, logarithmic if there is any error."""
    low, high = min(axes.dataLim.minposy for axes in row), max(axes.dataLim.y1 for axes in row)
    for axes in row:
        if low <= high:
            logarithmic(axes.yaxis)
            axes.set_ylim(low / 1.5, high * 1.5)
        whole_numbers(axes.xaxis)
        plain(axes)
