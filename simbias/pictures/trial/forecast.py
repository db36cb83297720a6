"""An experiment as simulation foretells it, with what the learner leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from threadpoolctl import threadpool_limits

from simbias.pictures.panels import headline, legend, panels
from simbias.pictures.style import HARDWARE, NOMINAL, SIMULATION, label, plain
from simbias.pictures.trial.compared import experiments_before, outcome_words, policy_words, worst
from simbias.records import Array, Iteration
from simbias.study import Study

HEIGHT, COLUMNS = 1.5, 3  # in, of a panel; panels in a row
DRAWS, SEED = 20, 0
BAND = (0.05, 0.95)  # quantiles
POINTS = 250  # of the band along the time


def forecast(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """Every state over time in s, in the worst experiment of the last iteration and as predicted.

    All predictions run the experiment's policy from its start, to failure or horizon: on the nominal model
    with the learned bias, as the policy search did, and on the nominal model alone. The band holds nine
    tenths of the rollouts with biases drawn from the learner's posterior (`FittedBias.draw`): each draw is
    one function for a whole rollout, so that its errors add up, or cancel, as those of the mean would.
    Without noise, and without what a draw leaves out; a draw that has failed is not in the band any more.
    """
    task, iteration = study.task, iterations[-1]
    measured, theta = worst(iteration), iteration.optimum.parameters
    start = measured.states[0]
    corrected, nominal = (study.simulate(theta, bias, start) for bias in (iteration.fitted_bias, None))
    drawn = _drawn(study, iteration, start)
    columns = min(COLUMNS, len(task.states))
    figure, grid = panels(-(-len(task.states) // columns), columns, HEIGHT)
    for axes in grid.flat[len(task.states) :]:
        axes.axis("off")
    for i, (axes, quantity) in enumerate(zip(grid.flat, task.states, strict=False)):
        shown = [measured.states[:, i], corrected.states[:, i], nominal.states[:, i]]
        for values, color, line in zip(shown, (HARDWARE, SIMULATION, NOMINAL), ("-", "--", ":"), strict=True):
            axes.plot(task.time_step * np.arange(len(values)), values, line, color=color, linewidth=1.0)
        if drawn is not None:
            _draw_band(axes, task.time_step, drawn[:, :, i])
        axes.set_ylim(*_view(shown[:2]))
        axes.set_xlim(0.0, task.horizon * task.time_step)
        axes.set_xlabel("time (s)", labelpad=1)
        axes.set_ylabel(label(quantity), labelpad=1)
        plain(axes)
    headline(grid[0, 0], f"{policy_words(iteration)}: {outcome_words(study, measured)}")
    legend(figure, _entries(drawn))
    return figure


@threadpool_limits.wrap(limits=1, user_api="blas")
def _drawn(study: Study, iteration: Iteration, start: Array) -> Array | None:
    """States (`DRAWS`, T+1, n) with biases drawn from the posterior, nan after failures; None without one."""
    fitted_bias, rng = iteration.fitted_bias, np.random.default_rng(SEED)
    if fitted_bias is None or not experiments_before(iteration) or fitted_bias.draw(rng) is fitted_bias:
        return None
    drawn = np.full((DRAWS, study.task.horizon + 1, len(study.task.states)), np.nan)
    for states in drawn:
        rollout = study.simulate(iteration.optimum.parameters, fitted_bias.draw(rng), start)
        states[: len(rollout.states)] = rollout.states
    return drawn


def _draw_band(axes: Axes, time_step: float, drawn: Array) -> None:
    """The quantiles of the draws (`DRAWS`, T+1) that still run."""
    running = int(np.isfinite(drawn).any(axis=0).sum())
    frames = np.unique(np.linspace(0, running - 1, POINTS).round().astype(int))
    low, high = np.nanquantile(drawn[:, frames], BAND, axis=0)
    axes.fill_between(time_step * frames, low, high, color=SIMULATION, alpha=0.2, linewidth=0.0, zorder=1)


def _view(shown: Sequence[Array]) -> tuple[float, float]:
    """Limits of an axis that hold what is shown, and some of what is about it."""
    low, high = min(values.min() for values in shown), max(values.max() for values in shown)
    return low - 0.25 * (high - low), high + 0.25 * (high - low)


def _entries(drawn: Array | None) -> dict[str, Line2D | Patch]:
    """What is seen."""
    entries: dict[str, Line2D | Patch] = {
        "hardware": Line2D([], [], color=HARDWARE),
        "nominal model + learned bias": Line2D([], [], color=SIMULATION, linestyle="--"),
        "nominal model alone": Line2D([], [], color=NOMINAL, linestyle=":"),
    }
    if drawn is not None:
        failed = int(np.isnan(drawn[:, -1]).any(axis=1).sum())
        words = f"90 % of {DRAWS} draws of the bias" + (f", {failed} fail" if failed else "")
        entries[words] = Patch(color=SIMULATION, alpha=0.2)
    return entries
