"""An experiment and its forecast in simulation, with the learner's uncertainty band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from threadpoolctl import threadpool_limits

from simbias.core import Model
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures.elements.layout import headline, legend, panels
from simbias.pictures.elements.style import NOMINAL, SIMULATION, label, plain
from simbias.pictures.trial.comparison import (
    NamedRollout,
    compared_words,
    in_simulation,
    learned_before,
    on_hardware,
    on_nominal,
    worst_experiment,
)
from simbias.trial.study import Study

HEIGHT = 1.5  # in, of a panel
DRAWS, SEED = 20, 0
BAND = (0.05, 0.95)  # quantiles
POINTS = 250  # of the band along time
EDGE = 0.03  # of the axes' height: a bar where the band exceeds them


def forecast(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """Every state of the robot over time in s: the last policy's worst experiment, and predictions.

    All predictions run the experiment's policy from its start, to failure or horizon: on the nominal model
    alone and, if anything was learned, with the learned bias, as in the policy search. The band contains 90%
    of the rollouts with biases drawn from the learner's posterior (`FittedBias.draw`). Each draw is one
    function for a whole rollout, so its errors accumulate or cancel like those of the mean. The band excludes
    noise, effects that draws omit, and draws after their failure. The axes contain the experiment and its
    best prediction; bars at the edges mark where the band and the nominal model exceed them.

    Raises
    ------
    NoPictureError
        If no policy was tried on the hardware.
    """
    task, iteration = study.task, on_hardware(iterations)[-1]
    experiment = worst_experiment(study, iteration)
    curves, draws = [NamedRollout("hardware", experiment)], None
    model = iteration.model
    if model is not None and learned_before(iterations, iteration):
        learned = in_simulation(study, iterations, iteration, experiment)
        assert learned is not None
        curves.append(learned)
        draws = _draws(study, model, experiment)
    curves.append(nominal := on_nominal(study, iteration, experiment))
    states = task.without_targets.states
    figure, (grid,) = panels(len(states), HEIGHT, 2 if len(states) == 4 else 3)
    beyond: dict[str, Artist] = {}
    for i, (axes, quantity) in enumerate(zip(grid, states, strict=True)):
        for _, rollout, color, line in curves:
            times = task.time_step * np.arange(len(rollout.states))
            axes.plot(times, rollout.states[:, i], line, color=color, linewidth=1.0)
        axes.set_ylim(*_view([curve.rollout.states[:, i] for curve in curves[:2]]))
        axes.set_xlim(0.0, task.horizon * task.time_step)
        if band := draws is not None and _draw_band(axes, task.time_step, draws[0][:, :, i]):
            beyond["the band leaves the axes"] = Patch(color=SIMULATION)
        values = nominal.rollout.states[:, i]
        times = task.time_step * np.arange(len(values), dtype=np.float64)
        if _mark_beyond(axes, times, values, values, NOMINAL, int(band)):
            beyond["the nominal model leaves the axes"] = Patch(color=NOMINAL)
        axes.set(xlabel="time (s)", ylabel=label(quantity))
        plain(axes)
    headline(grid[0], compared_words(study, iteration))
    legend(figure, _entries(curves, draws) | beyond)
    return figure


@threadpool_limits.wrap(limits=1, user_api="blas")
def _draws(study: Study, model: Model, experiment: Rollout) -> tuple[Array, str] | None:
    """States (`DRAWS`, T+1, n) of an experiment on draws from the posterior, nan after failures; and of what.

    None if the learner has no draws.
    """
    rng, own = np.random.default_rng(SEED), study.designed_on(model)
    nominal, bias = model.nominal, model.bias
    told = {each.name for each in nominal.estimates}
    identified = any(each.name in told for each in nominal.parameters)  # else draws are from the prior
    drawn_of = ["model"] * identified + ["bias"] * (bias.draw(rng) is not bias)
    if not drawn_of:
        return None
    draws = np.full((DRAWS, study.task.horizon + 1, len(study.task.states)), np.nan)
    for states in draws:
        drawn = nominal.draw(rng) if identified else nominal
        rollout = own.simulate(experiment.parameters, bias.draw(rng), experiment.states[0], drawn)
        states[: len(rollout.states)] = rollout.states
    return draws, " and ".join(drawn_of)


def _draw_band(axes: Axes, time_step: float, draws: Array) -> bool:
    """Draw the quantiles of the draws (`DRAWS`, T+1) that still run; return whether they exceed the axes."""
    running = int(np.isfinite(draws).any(axis=0).sum())
    frames = np.unique(np.linspace(0, running - 1, POINTS).round().astype(int))
    low, high = np.nanquantile(draws[:, frames], BAND, axis=0)
    times, view = time_step * frames, axes.get_ylim()
    axes.fill_between(times, low, high, color=SIMULATION, alpha=0.2, linewidth=0.0, zorder=1)
    axes.set_ylim(view)
    return _mark_beyond(axes, times, low, high, SIMULATION, 0)


def _mark_beyond(axes: Axes, times: Array, low: Array, high: Array, color: str, row: int) -> bool:
    """Draw bars, in this row from the edge, where values (k,) exceed the axes; return whether they do."""
    bottom, top = axes.get_ylim()
    near, far = row * EDGE, (row + 1) * EDGE
    edges = ((1.0 - far, 1.0 - near, high > top), (near, far, low < bottom))
    for lower, upper, outside in edges:
        if outside.any():
            on_edge = axes.get_xaxis_transform()
            axes.fill_between(times, lower, upper, where=outside, step="mid", color=color, transform=on_edge)
    axes.set_ylim(bottom, top)
    return any(outside.any() for *_, outside in edges)


def _view(curves: Sequence[Array]) -> tuple[float, float]:
    """Limits of an axis that contain all curves, with a margin."""
    low, high = min(values.min() for values in curves), max(values.max() for values in curves)
    margin = 0.25 * (high - low) or 1.0
    return low - margin, high + margin


def _entries(curves: Sequence[NamedRollout], draws: tuple[Array, str] | None) -> dict[str, Artist]:
    """The legend."""
    entries: dict[str, Artist] = {
        curve.name: Line2D([], [], color=curve.color, linestyle=curve.line) for curve in curves
    }
    if draws is not None:
        states, drawn_of = draws
        failures = int(np.isnan(states[:, -1]).any(axis=1).sum())
        failed = f", {failures} fail" if failures else ""
        words = f"at each time, 90% of {DRAWS} draws of {drawn_of}{failed}"
        entries[words] = Patch(color=SIMULATION, alpha=0.2)
    return entries
