"""A whole trial in one picture: its first and last policies on hardware."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from simbias.core.records import Array, Indices, Iteration, Rollout
from simbias.pictures.elements.drawing import drawing_of, share_view
from simbias.pictures.elements.layout import WIDTH, headline
from simbias.pictures.elements.style import (
    HARDWARE,
    SIMULATION,
    SMALL,
    in_powers,
    label,
    logarithmic_if_wide,
    plain,
    seconds,
    shade_beyond,
    whole_numbers,
)
from simbias.pictures.trial.comparison import (
    NamedRollout,
    compared_words,
    cost_limit,
    cost_markers,
    failure_words,
    first_and_last,
    hardware_words,
    in_simulation,
    on_hardware,
    policy_experiments,
    simulated,
    worst_experiment,
)
from simbias.pictures.trial.snapshots import draw_strip
from simbias.trial.study import Study

COLUMNS = 6  # of snapshots
PANEL, LABELS = 1.25, 1.4  # in, heights of a panel, and of the text above and below it
SNAPSHOT = 1.02  # in, width
PAD = 0.08  # in, above and below
WIDTHS = (4.0, 1.0)  # relative widths of the policies and the costs
POINTS = 200  # of a cost over time
Z_MAX = r"limit $Z_{\max}$"


class Measure(NamedTuple):
    """A quantity of a rollout over time, and its limit."""

    label: str
    limit: float
    limit_label: str
    of: Callable[[Rollout], tuple[Indices, Array]]  # frames (k,) and values (k,)


def overview(study: Study, iterations: Sequence[Iteration]) -> Figure:
    """A trial's first and last policies on hardware, and all costs.

    For each policy: snapshots of its worst hardware experiment, if the task has a drawing. Below them, over
    the same time in s, are that experiment and its repetition in the simulation of the policy's search, if
    any. They show the measure of the violated criterion, in its unit, with its limit; if no experiment
    failed, or this policy was too costly, the cost so far. If the task states conditions of success, the
    experiment's uptime is named. Right: the cost of every hardware experiment of the trial, with crosses as
    in `costs`, and its cost from the same start in the simulation of its policy's search.

    Raises
    ------
    NoPictureError
        If no policy was tried on the hardware.
    """
    draw = drawing_of(study.task)
    both = first_and_last(on_hardware(iterations))
    layout = ConstrainedLayoutEngine(h_pad=PAD)
    figure = Figure(layout=layout)
    left, right = figure.subfigures(1, 2, width_ratios=WIDTHS, squeeze=False)[0]
    blocks = left.subfigures(len(both), squeeze=False)[:, 0]
    shown = [worst_experiment(study, iteration) for iteration in both]
    times = np.linspace(0.0, seconds(study.task, study.task.horizon), COLUMNS)
    grids, snapshots = [], []
    for block, iteration, experiment in zip(blocks, both, shown, strict=True):
        grids.append(grid := block.add_gridspec(2 if draw else 1, COLUMNS))
        above = block.add_subplot(grid[-1, :])
        measure = _measure(study, experiment, shown)
        _draw_measure(above, study, _rollouts(study, iterations, iteration), measure, times)
        if draw:
            strip = [block.add_subplot(grid[0, column]) for column in range(COLUMNS)]
            draw_strip(strip, study.task, experiment, times, draw)
            snapshots += strip
            headline(strip[0], compared_words(study, iteration), "large")
        else:  # above the legend
            words = compared_words(study, iteration)
            block.suptitle(words, x=0.01, ha="left", fontsize="large", fontweight="bold")
    share_view(snapshots)
    heights = [SNAPSHOT * snapshots[0].get_data_ratio(), PANEL] if draw else [PANEL]
    for grid in grids:
        grid.set_height_ratios(heights)
    figure.set_size_inches(WIDTH, len(both) * (sum(heights) + LABELS))
    _draw_costs(right.add_subplot(), study, iterations)
    layout.execute(figure)  # drawing repeats this: once would leave labels of nested subfigures cut
    return figure


def _rollouts(study: Study, iterations: Sequence[Iteration], iteration: Iteration) -> list[NamedRollout]:
    """An iteration's worst experiment with its uptime, preceded by its simulation if there was a search."""
    experiment, count = worst_experiment(study, iteration), len(policy_experiments(iteration))
    uptime = study.task.uptime(experiment.states)
    name = hardware_words(study) + (f", worst of {count}" if count > 1 else "")
    name += "" if np.isnan(uptime) else f", uptime {uptime:.0%}"
    simulation = in_simulation(study, iterations, iteration, experiment)
    return [*([simulation] if simulation else []), NamedRollout(name, experiment)]


def _measure(study: Study, experiment: Rollout, shown: Sequence[Rollout]) -> Measure:
    """The criterion violated in an experiment, or else the first violated in those shown.

    If none was violated, or the experiment lasts but does not succeed, it is the cost.
    """
    task = study.task
    names = [criterion.name for criterion in task.criteria]
    failures = [rollout.failure for rollout in (experiment, *shown) if rollout.failure in names]
    too_costly = experiment.failed_at is None and not study.passes(experiment)
    if too_costly or not failures:
        return _cost_so_far(study)
    index = names.index(str(failures[0]))
    return Measure(
        f"criterion\n{label(task.criteria[index])}",
        task.criteria[index].limit,
        "limit",
        lambda rollout: (np.arange(len(rollout.states)), task.measure(rollout.states)[:, index]),
    )


def _cost_so_far(study: Study) -> Measure:
    """The cost of a rollout truncated at several frames; at its end, that of the whole."""

    def so_far(rollout: Rollout) -> tuple[Indices, Array]:
        frames = np.unique(np.linspace(1, rollout.frames, POINTS).round().astype(int))
        return frames, np.array([study.cost.of(rollout.part(0, k)) for k in frames])

    return Measure("cost Z so far", cost_limit(study), Z_MAX, so_far)


def _draw_measure(
    axes: Axes, study: Study, rollouts: Sequence[NamedRollout], measure: Measure, ticks: Array
) -> None:
    """Draw a measure over time, in simulation and on hardware, with a tick below each snapshot."""
    values, named = [measure.limit], rollouts[-1].rollout.failure
    for name, rollout, color, line in rollouts:
        frames, measures = measure.of(rollout)
        times = study.task.time_step * frames
        if rollout.failure not in (None, named):
            name = f"{name}, until {failure_words(study, rollout)}"
        axes.plot(times, measures, line, color=color, label=name)
        if rollout.failed_at is not None:
            axes.plot(times[-1], measures[-1], "X", color=color, markersize=9, zorder=3, clip_on=False)
        values += measures.tolist()
    if measure.limit_label == Z_MAX:
        logarithmic_if_wide(values, axes.yaxis)
    axes.set_xlim(ticks[0] - ticks[1] / 2, ticks[-1] + ticks[1] / 2)
    axes.set_xticks(ticks)
    axes.set(xlabel="time (s)", ylabel=measure.label)
    shade_beyond(axes, measure.limit, measure.limit_label, "left")  # a rollout begins far from the limit
    beside = measure.limit if np.isfinite(measure.limit) else values[-1]
    _name_failure(axes, study, rollouts[-1].rollout, beside)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.1, frameon=False, fontsize=SMALL)
    plain(axes)


def _name_failure(axes: Axes, study: Study, rollout: Rollout, beside: float) -> None:
    """Write the reason of a failure near its end: above the limit, where there is room, or above the end."""
    if rollout.failed_at is not None:
        late = 2 * rollout.failed_at > study.task.horizon
        axes.annotate(
            failure_words(study, rollout),
            (seconds(study.task, rollout.failed_at), beside),
            xytext=(-9 if late else 9, 2),
            textcoords="offset points",
            ha="right" if late else "left",
            color=HARDWARE,
            fontsize=SMALL,
            zorder=4,
        )


def _draw_costs(axes: Axes, study: Study, iterations: Sequence[Iteration]) -> None:
    """Draw the cost of every hardware experiment, and that of its simulation."""
    limit, entries = cost_limit(study), dict[str, Line2D]()
    values = [limit]
    for iteration in iterations:
        measured, last = [rollout.cost for rollout in iteration.experiments], iteration.total_experiments
        numbers = np.arange(last - len(measured), last) + 1
        for marker, some in cost_markers(study, iteration.experiments):
            (line,) = axes.plot(numbers[some], np.array(measured)[some], marker, color=HARDWARE, zorder=3)
            entries["hardware" if marker == "o" else "no success"] = line
        models = [rollout.cost for rollout in simulated(study, iteration, iteration.experiments)]
        if models:
            (entries["simulation,\nsame start"],) = axes.plot(
                numbers, models, "o", color=SIMULATION, markerfacecolor="none", zorder=4
            )
        values += measured + models
    logarithmic_if_wide(values, axes.yaxis)
    power = in_powers(values, axes.yaxis)
    whole_numbers(axes.xaxis)
    axes.set_xlim(0.5, iterations[-1].total_experiments + 0.5)
    axes.set(xlabel="hardware\nexperiment", ylabel=f"cost Z ({power or 'dimensionless'})")
    shade_beyond(axes, limit, Z_MAX)
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
