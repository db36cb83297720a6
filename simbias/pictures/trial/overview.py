"""A whole trial in one picture: what its first policy did on hardware, and what its last."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpecBase
from matplotlib.ticker import MaxNLocator

from simbias.core import Task
from simbias.core.records import Array, Iteration, Rollout
from simbias.pictures.elements.drawing import Drawing, drawing_of, share_view
from simbias.pictures.elements.style import (
    HARDWARE,
    SIMULATION,
    SMALL,
    label,
    logarithmic,
    plain,
    seconds,
    shade_beyond,
)
from simbias.pictures.trial.comparison import (
    failure_words,
    first_and_last,
    hardware_words,
    on_hardware,
    outcome_words,
    policy_experiments,
    policy_words,
    search_bias,
    search_nominal,
    search_samples,
    simulation_words,
    worst_experiment,
)
from simbias.pictures.trial.snapshots import draw_strip
from simbias.trial.study import Study

COLUMNS = 6  # of snapshots
WIDTH, TITLE, SNAPSHOTS, MEASURE, TIME_AXIS = 9.0, 0.4, 1.2, 1.3, 0.42  # in
BLOCK_SIDES, COST_SIDES = {"left": 0.07, "right": 0.755}, {"left": 0.84, "right": 0.97}  # of the width


class Comparison(NamedTuple):
    """A policy on the hardware and, from the same start, in the simulation that it was searched in."""

    headline: str
    hardware_label: str
    hardware: Rollout
    simulation_label: str
    simulation: Rollout | None  # None without such a search


def overview(study: Study, iterations: Sequence[Iteration], draw: Drawing | None = None) -> Figure:
    """What a trial's first policy did on hardware, and its last.

    For each of the two: snapshots of the worst of its hardware experiments, where the task has a drawing.
    Below them, over the same time in s: the measure of the criterion that failed, in its unit, against its
    limit, in that experiment and in the simulation that the policy was searched in, if it was, from the
    experiment's start. At the right: the cost of every hardware experiment of the trial, and the cost that
    a search had predicted for its policy.

    Raises
    ------
    NoPictureError
        If no policy was tried on the hardware.
    """
    task, draw = study.task, draw or drawing_of(study.task)
    both = first_and_last(on_hardware(iterations))
    comparisons = [_compare(study, iterations, iteration) for iteration in both]
    heights = [TITLE, SNAPSHOTS if draw else 0.0, MEASURE, TIME_AXIS]
    height = len(comparisons) * sum(heights)
    figure = Figure(figsize=(WIDTH, height))
    blocks = figure.add_gridspec(len(comparisons), 1, **BLOCK_SIDES, bottom=0.0, top=1.0, hspace=0.0)
    criterion = _criterion(task, [comparison.hardware for comparison in comparisons])
    drawings: list[Axes] = []
    for index, comparison in enumerate(comparisons):
        grid = blocks[index].subgridspec(4, COLUMNS, wspace=0.0, hspace=0.0, height_ratios=heights)
        drawings += _draw_block(figure, grid, study, comparison, criterion, draw)
    share_view(drawings)
    sides = COST_SIDES | {"bottom": TIME_AXIS / height, "top": 1 - TITLE / height}
    _draw_costs(figure.add_subplot(figure.add_gridspec(1, 1, **sides)[0]), study, iterations)
    return figure


def _draw_block(
    figure: Figure,
    grid: GridSpecBase,
    study: Study,
    comparison: Comparison,
    criterion: int,
    draw: Drawing | None,
) -> list[Axes]:
    """Headline, snapshots and measure of a policy; return the axes of the snapshots."""
    headline = figure.add_subplot(grid[0, :])
    headline.axis("off")
    headline.text(0.0, 0.3, comparison.headline, fontsize="large", fontweight="bold")
    task = study.task
    times = np.linspace(0.0, seconds(task, task.horizon), COLUMNS)
    row = [figure.add_subplot(grid[1, column]) for column in range(COLUMNS)] if draw else []
    if draw:
        draw_strip(row, task, comparison.hardware, times, draw)
    _draw_measure(figure.add_subplot(grid[2, :]), study, comparison, criterion, times)
    return row


def _compare(study: Study, iterations: Sequence[Iteration], iteration: Iteration) -> Comparison:
    """The worst hardware experiment of an iteration's policy, and the same in simulation."""
    experiment, count = worst_experiment(iteration), len(policy_experiments(iteration))
    bias, simulation = search_bias(iteration), None
    if bias is not None:
        simulation = study.simulate(
            experiment.parameters, bias, experiment.states[0], search_nominal(iteration)
        )
    return Comparison(
        headline=f"{policy_words(iteration)}: {outcome_words(study, experiment)}",
        hardware_label=hardware_words(study) + (f", worst of {count}" if count > 1 else ""),
        hardware=experiment,
        simulation_label=simulation_words(study, search_samples(iterations, iteration)),
        simulation=simulation,
    )


def _criterion(task: Task, rollouts: Sequence[Rollout]) -> int:
    """Index of the criterion that the first failed rollout failed; of the first one if none failed any."""
    names = [criterion.name for criterion in task.criteria]
    return next((names.index(rollout.failure) for rollout in rollouts if rollout.failure in names), 0)


def _draw_measure(axes: Axes, study: Study, comparison: Comparison, index: int, ticks: Array) -> None:
    """The measure of a criterion over time, in simulation and on hardware; a tick below each snapshot."""
    task, criterion = study.task, study.task.criteria[index]
    for rollout, name, color, line in (
        (comparison.simulation, comparison.simulation_label, SIMULATION, "--"),
        (comparison.hardware, comparison.hardware_label, HARDWARE, "-"),
    ):
        if rollout is None:
            continue
        measures = task.measure(rollout.states)[:, index]
        times = task.time_step * np.arange(len(measures))
        axes.plot(times, measures, line, color=color, label=name)
        if rollout.failed_at is not None:
            axes.plot(times[-1], measures[-1], "X", color=color, markersize=9, zorder=3, clip_on=False)
    axes.set_xlim(ticks[0] - ticks[1] / 2, ticks[-1] + ticks[1] / 2)
    axes.set_xticks(ticks)
    axes.set_xlabel("time (s)", labelpad=1)
    axes.set_ylabel(label(criterion), labelpad=1)
    shade_beyond(axes, criterion.limit, "limit")
    _tell_failure(axes, study, comparison.hardware, criterion.limit)
    axes.legend(loc="best", bbox_to_anchor=(0.0, 0.0, 1.0, 0.87), frameon=False, fontsize=SMALL)
    plain(axes)


def _tell_failure(axes: Axes, study: Study, rollout: Rollout, limit: float) -> None:
    """Why a rollout failed, next to its end, beyond the limit: there is nothing else."""
    if rollout.failed_at is not None:
        late = 2 * rollout.failed_at > study.task.horizon
        axes.annotate(
            failure_words(study, rollout),
            (seconds(study.task, rollout.failed_at), limit),
            xytext=(-9 if late else 9, 2),
            textcoords="offset points",
            ha="right" if late else "left",
            color=HARDWARE,
            fontsize=SMALL,
        )


def _draw_costs(axes: Axes, study: Study, iterations: Sequence[Iteration]) -> None:
    """The cost of every hardware experiment and, of each policy that was searched, the predicted one."""
    values, entries = [study.cost.max_cost], {}
    for iteration in iterations:
        last, costs = iteration.total_experiments, [rollout.cost for rollout in iteration.experiments]
        numbers = np.arange(last - len(costs), last) + 1
        (entries["hardware"],) = axes.plot(numbers, costs, "o", color=HARDWARE, zorder=3)
        values += costs
        if iteration.search is not None and costs:
            predicted_cost, sides = iteration.search.predicted_cost, [numbers[0] - 0.4, numbers[-1] + 0.4]
            (entries["predicted"],) = axes.plot(sides, [predicted_cost] * 2, color=SIMULATION, linewidth=2.5)
            values.append(predicted_cost)
    if 0 < 10 * min(values) < max(values):
        logarithmic(axes, "y")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    axes.set_xlabel("hardware experiment", labelpad=1)
    axes.set_ylabel("cost Z (dimensionless)", labelpad=1)
    shade_beyond(axes, study.cost.max_cost, r"limit $Z_{\max}$")
    axes.legend(
        list(entries.values()),
        list(entries),
        loc="lower left",
        bbox_to_anchor=(-0.1, 1.0),
        borderaxespad=0.2,
        frameon=False,
        fontsize=SMALL,
    )
    plain(axes)
