"""An experiment as simulation foretells it, with what the learner leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from threadpoolctl import threadpool_limits

from simbias.core import FittedBias, Nominal
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures.elements.panels import headline, legend, panels
from simbias.pictures.elements.style import HARDWARE, NOMINAL, SIMULATION, label, plain
from simbias.pictures.trial.comparison import (
    on_hardware,
    outcome_words,
    policy_words,
    search_bias,
    search_nominal,
    search_samples,
    worst_experiment,
)
from simbias.trial.study import Study

HEIGHT, COLUMNS = 1.5, 3  # in, of a panel; panels in a row
DRAWS, SEED = 20, 0
BAND = (0.05, 0.95)  # quantiles
POINTS = 250  # of the band along the time


def forecast(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """Every state over time in s, in the worst experiment of the last iteration's policy and as predicted.

    All predictions run the experiment's policy from its start, to failure or horizon: on the nominal model
    alone and, if anything was learned, with the learned bias, as the policy search did. The band holds nine
    tenths of the rollouts with biases drawn from the learner's posterior (`FittedBias.draw`): each draw is
    one function for a whole rollout, so that its errors add up, or cancel, as those of the mean would.
    Without noise, and without what a draw leaves out; a draw that has failed is not in the band any more.

    Raises
    ------
    NoPictureError
        If no policy was tried on the hardware.
    """
    task, iteration = study.task, on_hardware(iterations)[-1]
    experiment = worst_experiment(iteration)
    curves = [Curve("hardware", experiment, HARDWARE, "-")]
    model = search_nominal(iteration)
    bias = search_bias(iteration) if search_samples(iterations, iteration) else None
    if bias is not None:
        rollout = study.simulate(experiment.parameters, bias, experiment.states[0], model)
        curves.append(Curve("nominal model + learned bias", rollout, SIMULATION, "--"))
    nominal = study.simulate(experiment.parameters, None, experiment.states[0])
    curves.append(Curve("nominal model alone", nominal, NOMINAL, ":"))
    draws = None if bias is None else _draws(study, bias, experiment, model)
    columns = min(COLUMNS, len(task.states))
    figure, grid = panels(-(-len(task.states) // columns), columns, HEIGHT)
    for axes in grid.flat[len(task.states) :]:
        axes.axis("off")
    for i, (axes, quantity) in enumerate(zip(grid.flat, task.states, strict=False)):
        for _, rollout, color, line in curves:
            times = task.time_step * np.arange(len(rollout.states))
            axes.plot(times, rollout.states[:, i], line, color=color, linewidth=1.0)
        if draws is not None:
            _draw_band(axes, task.time_step, draws[:, :, i])
        axes.set_ylim(*_view([curve.rollout.states[:, i] for curve in curves[:2]]))
        axes.set_xlim(0.0, task.horizon * task.time_step)
        axes.set_xlabel("time (s)", labelpad=1)
        axes.set_ylabel(label(quantity), labelpad=1)
        plain(axes)
    headline(grid[0, 0], f"{policy_words(iteration)}: {outcome_words(study, experiment)}")
    legend(figure, _entries(curves, draws))
    return figure


class Curve(NamedTuple):
    """A rollout, and how it is drawn."""

    name: str
    rollout: Rollout
    color: str
    line: Literal["-", "--", ":"]


@threadpool_limits.wrap(limits=1, user_api="blas")
def _draws(study: Study, bias: FittedBias, experiment: Rollout, nominal: Nominal | None) -> Array | None:
    """States (`DRAWS`, T+1, n) of an experiment with models drawn from the posterior, nan after failures.

    None where a learner does not draw.
    """
    rng = np.random.default_rng(SEED)
    identified = nominal is not None and bool(nominal.estimates)
    if bias.draw(rng) is bias and not identified:
        return None
    draws = np.full((DRAWS, study.task.horizon + 1, len(study.task.states)), np.nan)
    for states in draws:
        drawn = nominal.draw(rng) if nominal is not None and identified else nominal
        rollout = study.simulate(experiment.parameters, bias.draw(rng), experiment.states[0], drawn)
        states[: len(rollout.states)] = rollout.states
    return draws


def _draw_band(axes: Axes, time_step: float, draws: Array) -> None:
    """The quantiles of the draws (`DRAWS`, T+1) that still run."""
    running = int(np.isfinite(draws).any(axis=0).sum())
    frames = np.unique(np.linspace(0, running - 1, POINTS).round().astype(int))
    low, high = np.nanquantile(draws[:, frames], BAND, axis=0)
    axes.fill_between(time_step * frames, low, high, color=SIMULATION, alpha=0.2, linewidth=0.0, zorder=1)


def _view(curves: Sequence[Array]) -> tuple[float, float]:
    """Limits of an axis that hold curves, and some of what is about them."""
    low, high = min(values.min() for values in curves), max(values.max() for values in curves)
    return low - 0.25 * (high - low), high + 0.25 * (high - low)


def _entries(curves: Sequence[Curve], draws: Array | None) -> dict[str, Line2D | Patch]:
    """What is seen."""
    entries: dict[str, Line2D | Patch] = {
        curve.name: Line2D([], [], color=curve.color, linestyle=curve.line) for curve in curves
    }
    if draws is not None:
        failures = int(np.isnan(draws[:, -1]).any(axis=1).sum())
        words = f"90 % of {DRAWS} draws of the bias" + (f", {failures} fail" if failures else "")
        entries[words] = Patch(color=SIMULATION, alpha=0.2)
    return entries
