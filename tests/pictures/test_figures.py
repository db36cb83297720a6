"""Every figure of a trial: its marks are the records' numbers, and its theory holds."""

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from figures import lines, texts
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from simbias.core import Quantity, rate_pairs
from simbias.core.parameters import Estimate, Parameter
from simbias.core.records import Iteration, Rollout
from simbias.pictures import costs, forecast, phases, prediction_errors, rejections
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import (
    HARDWARE,
    NOMINAL,
    SIMULATION,
    logarithmic,
    png,
    symbol,
    with_power,
)
from simbias.pictures.trial.comparison import simulated, worst_experiment
from simbias.pictures.trial.errors import prediction_error, windows
from simbias.pictures.trial.phases import state_bounds
from simbias.trial.study import Study


def color_of(each: Collection) -> str:
    return to_hex(each.get_facecolor()[0]).upper()


def again(study: Study, iteration: Iteration) -> list[Rollout]:
    """An iteration's experiments in the simulation that its policy was searched in."""
    return simulated(study, iteration, iteration.experiments)


def test_phases_show_every_rollout(short: Study, trial: list[Iteration]) -> None:
    """And shade what is beyond a limit that came near."""
    portrait, pairs = phases(short, trial), [(0, 3), (1, 4), (2, 5)]
    assert rate_pairs(short.task.states) == pairs
    for row, iteration in enumerate((trial[0], trial[-1])):
        for column, (i, rate) in enumerate(pairs):
            axes = portrait.axes[3 * row + column]
            measured = [rollout.states[:, (i, rate)] for rollout in iteration.experiments]
            models = [rollout.states[:, (i, rate)] for rollout in again(short, iteration)]
            for color, expected in ((HARDWARE, measured), (SIMULATION, models)):
                for curve, states in zip(lines(axes, color), expected, strict=True):
                    np.testing.assert_array_equal(curve, states)
            assert axes.get_xlabel() == f"{symbol(short.task.states[i].name)} (rad)"
            assert axes.get_ylabel().endswith("(rad/s)")
            crosses = sum(rollout.failed_at is not None for rollout in iteration.experiments)
            assert len(lines(axes, HARDWARE, "X")) == crosses
    assert any(rollout.failed_at is not None for rollout in trial[0].experiments)
    shaded = [patch for axes in portrait.axes[:3] for patch in axes.patches if isinstance(patch, Rectangle)]
    edges = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in shaded]
    assert short.task.limits.distance in np.abs(edges)
    assert {"failure", "beyond a limit"} < {text.get_text() for text in portrait.legends[0].get_texts()}


def test_phases_of_a_state_that_never_changes(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    """As of a target that stays where it is; without rates, there are none."""
    study, iterations = of_point_mass
    assert state_bounds(study.task)[1] == np.inf
    first = iterations[0]
    still = tuple(
        replace(each, states=np.zeros_like(each.states), measured=None) for each in first.experiments
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = phases(study, [replace(first, experiments=still, model=None)])
    (axes,), (legend,) = figure.axes, figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["start", "hardware"]
    assert axes.get_ylim()[0] < 0.0 < axes.get_ylim()[1]
    task = type(study.task)()
    task.states = (Quantity("position", "m"), Quantity("mass", "kg"))
    with pytest.raises(NoPictureError, match="per second"):
        phases(replace(study, task=task), iterations)


@pytest.mark.slow
def test_costs_are_those_of_the_records(short: Study, trial: list[Iteration]) -> None:
    by_iteration, pairs = costs(short, trial).axes
    measured = [[r.cost for r in iteration.experiments] for iteration in trial]
    models = [[r.cost for r in again(short, iteration)] for iteration in trial]
    assert [list(data[:, 1]) for data in lines(by_iteration, HARDWARE, "o")] == measured
    assert [list(data[:, 1]) for data in lines(by_iteration, SIMULATION, "o")] == models
    bars = [data for data in lines(by_iteration, SIMULATION) if len(data) == 2]
    assert [bar[0, 1] for bar in bars] == [iteration.search.predicted_cost for iteration in trial]
    for data, xs, ys in zip(lines(pairs, HARDWARE, "o"), models, measured, strict=True):
        np.testing.assert_array_equal(data, np.column_stack([xs, ys]))
    brightness = [np.mean(line.get_markerfacecolor()) for line in pairs.lines[: len(trial)]]
    assert brightness == sorted(brightness, reverse=True)
    assert brightness[0] > 1.5 * brightness[-1]
    searched, searchless = (
        texts(costs(short, each)) for each in (trial, [replace(one, search=None) for one in trial])
    )
    assert ("predicted by the search" in searched, "predicted by the search" in searchless) == (True, False)
    low, high = pairs.get_ylim()
    assert low < min(min(ys) for ys in measured) <= max(max(ys) for ys in measured) < high


def test_costs_have_no_limit_where_the_task_says_what_succeeds(short: Study, trial: list[Iteration]) -> None:
    """Experiments that do not are crosses."""
    task = copy(short.task)
    task.succeeds = lambda states: False  # type: ignore[method-assign]
    by_iteration, pairs = costs(replace(short, task=task), trial).axes
    measured = [[r.cost for r in iteration.experiments] for iteration in trial]
    assert [list(data[:, 1]) for data in lines(by_iteration, HARDWARE, "X")] == measured
    assert not [*by_iteration.patches, *by_iteration.collections[len(trial) :], *pairs.collections]
    assert "no success" in texts(costs(replace(short, task=task), trial))


def test_what_fails_at_a_cost_below_the_limit_is_a_cross(short: Study, trial: list[Iteration]) -> None:
    """As in the last frame, of which nothing is lost; nothing else is one."""
    fallen, *others = trial[1].experiments
    fallen = replace(fallen, failed_at=fallen.frames, failure=short.task.criteria[0].name)
    last = replace(trial[1], experiments=(fallen, *others))
    for figure, crosses in ((costs(short, [trial[0], last]), [fallen.cost]), (costs(short, trial), [])):
        for axes in figure.axes:
            assert [cost for data in lines(axes, HARDWARE, "X") for _, cost in data] == crosses
        assert ("no success" in texts(figure)) == bool(crosses)


def test_errors_are_those_of_steps_one_by_one(short: Study, trial: list[Iteration]) -> None:
    """Eq. 6, one frame ahead; and many frames ahead as stepping through them one by one gives it."""
    pieces = windows(short, trial[-1], 30)
    zero, learned = short.bias.fit(short.no_data), trial[-1].model.bias
    for bias in (zero, learned):
        one, many = prediction_error(bias, short.nominal, pieces, [1, 30])
        for piece, first in enumerate(pieces.firsts[:5].tolist()):
            states, path = pieces.states[first : first + 31], [pieces.states[first]]
            for u in pieces.inputs[first : first + 30]:
                path.append(short.nominal.step(path[-1], u) + bias.correction(path[-1], u))
            np.testing.assert_allclose(one[piece], path[1] - states[1], rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(many[piece], path[30] - states[30], rtol=1e-4, atol=1e-7)
        if bias is zero:
            without = many
    assert np.abs(many - without).max() > 1e-5


def test_error_marks_are_medians(short: Study, trial: list[Iteration]) -> None:
    figure, zero = prediction_errors(short, trial, [1, 20]), short.bias.fit(short.no_data)
    marks = [(iteration, zero, NOMINAL, "s", iteration.index) for iteration in trial]
    marks.append((trial[1], trial[1].model.bias, SIMULATION, "o", 0))  # nothing was learned before the first
    for iteration, bias, color, marker, number in marks:
        errors = prediction_error(bias, short.nominal, windows(short, iteration, 20), [1, 20])
        for row, states in enumerate((slice(0, 3), slice(3, 6))):
            for column in range(2):
                mark = lines(figure.axes[2 * row + column], color, marker)[number]
                norms = np.linalg.norm(errors[column][:, states], axis=1)
                assert mark[0, 1] == pytest.approx(np.median(norms))
    assert [axes.get_ylabel().split(" (")[-1] for axes in figure.axes[::2]] == ["rad)", "rad/s)"]
    assert figure.axes[1].get_title() == "20 frames ahead (20 ms)"
    assert "markers: medians, bars: quartiles" in texts(figure)
    alone = prediction_errors(short, trial[:1], [1])
    assert lines(alone.axes[0], NOMINAL, "s")[0][0, 0] == 0.0  # on its tick
    slow = copy(short.task)
    slow.time_step = 60.0
    first, *_ = prediction_errors(replace(short, task=slow), trial, [1]).axes
    assert first.get_title() == "1 frame ahead (60 s)"


@pytest.mark.slow
def test_experiments_shorter_than_the_horizon_are_left_out(short: Study, trial: list[Iteration]) -> None:
    first = trial[0].experiments[0]
    cut = replace(first, states=first.states[:11], inputs=first.inputs[:10], failed_at=10)
    brief = replace(trial[0], experiments=(cut,))
    assert [len(windows(short, brief, horizon)) for horizon in (10, 11)] == [1, 0]
    assert len(prediction_errors(short, [brief], [1, 20]).axes) == 2  # one horizon, two units
    assert len(prediction_errors(short, [brief, trial[0]], [1, 20]).axes) == 4  # of the other iteration's
    exact = replace(trial[0], experiments=tuple(again(short, trial[0])))  # hardware that is the model
    png(prediction_errors(short, [exact], [1, 5]))  # on a logarithmic scale


@pytest.mark.slow
def test_forecast_shows_the_experiment_and_its_predictions(short: Study, trial: list[Iteration]) -> None:
    """A band begins at the start, known for sure, and grows; bars show where it leaves the axes."""
    last, figure, left, gone = trial[-1], forecast(short, trial), [], []
    measured = worst_experiment(short, last)
    corrected = short.simulate(last.parameters, last.model.bias, measured.states[0])
    nominal = short.simulate(last.parameters, None, measured.states[0])
    for i, axes in enumerate(figure.axes):
        for color, rollout in ((HARDWARE, measured), (SIMULATION, corrected), (NOMINAL, nominal)):
            (curve,) = lines(axes, color)
            np.testing.assert_array_equal(curve[:, 1], rollout.states[:, i])
        band, *bars = (each for each in axes.collections if color_of(each) == SIMULATION)
        (path,) = band.get_paths()
        at, values = path.vertices.T
        width = {t: np.ptp(values[np.isclose(at, t, atol=1e-3)]) for t in (at.min(), at.max())}
        assert width[at.min()] == pytest.approx(0.0, abs=1e-12)
        assert width[at.max()] > 1e-3
        bottom, top = axes.get_ylim()
        assert len(bars) == int(values.max() > top) + int(values.min() < bottom)
        beyond = [each for each in axes.collections if color_of(each) == NOMINAL]
        alone = nominal.states[:, i]
        assert len(beyond) == int(alone.max() > top) + int(alone.min() < bottom)
        left, gone = left + bars, gone + beyond
    assert left
    assert "90% of 20 draws of bias" in (words := texts(figure))
    assert "the band leaves the axes" in words
    assert bool(gone) == ("the nominal model leaves the axes" in words)
    assert not any(axes.collections for axes in forecast(short, trial[:1]).axes)  # nothing was learned
    late = copy(last.model.nominal)  # whose delay is identified, and nothing else
    late.parameters = (Parameter("wheel_mass", "kg", 2.0, 0.1),)
    late.estimates = (Estimate("delay", "s", 0.0, 0.02, 0.01, 0.03),)
    told = replace(last, model=replace(last.model, nominal=late))
    assert "90% of 20 draws of bias" in texts(forecast(short, [*trial[:-1], told]))


def test_rejections_count_every_sample(short: Study, trial: list[Iteration]) -> None:
    axes = rejections(short, trial).axes[0]
    bars = {container.get_label(): [bar.get_width() for bar in container] for container in axes.containers}
    assert bars["accepted"] == [len(iteration.learning.selection.transitions) for iteration in trial]
    assert np.sum(list(bars.values()), axis=0).tolist() == [i.learning.selection.sampled for i in trial]
    texts = [text.get_text() for text in axes.texts]
    for iteration in trial:
        assert any(text.startswith(f"{len(iteration.learning.data)} in D") for text in texts)
    assert [text.endswith("a pass adds none") for text in texts if "in D" in text] == [False, True]


@pytest.mark.slow
def test_what_a_trial_lacks_is_not_shown(
    short: Study, trial: list[Iteration], on_hardware: list[Iteration]
) -> None:
    """Of a method without search, no prediction; of several policies, that at which an iteration arrived."""
    (curve,) = lines(forecast(short, on_hardware).axes[0], HARDWARE)
    best = min(on_hardware[-1].experiments, key=lambda rollout: rollout.cost)
    np.testing.assert_array_equal(curve[:, 1], best.states[:, 0])
    for picture in (phases, forecast, prediction_errors):
        for axes in picture(short, on_hardware).axes:
            assert not lines(axes, SIMULATION) + lines(axes, SIMULATION, "o")
    taught_nothing = [replace(iteration, learning=None) for iteration in trial]
    assert not lines(forecast(short, taught_nothing).axes[0], SIMULATION)
    assert lines(phases(short, taught_nothing).axes[0], SIMULATION)
    untried = replace(trial[1], experiments=(), total_experiments=2)  # it may be left for another day
    figure, alone = (phases(short, iterations) for iterations in ([trial[0], untried], trial[:1]))
    assert len(figure.axes) == len(alone.axes)
    png(costs(short, [trial[0], untried]))


def test_numbers_of_logarithmic_axes() -> None:
    """Between decades where there are few of them, and with powers of ten far from 1."""
    assert [with_power(each) for each in (1e-6, 3e-10, 200.0)] == ["10⁻⁶", "3·10⁻¹⁰", "2·10²"]
    for low, high, least in ((0.5, 1.2, 3), (1e-6, 9e-6, 3), (0.02, 2.0, 4), (1e-8, 1e-3, 3), (2.1, 8.5, 2)):
        axis = Figure().add_subplot()
        logarithmic(axis.yaxis)
        axis.set_ylim(low, high)
        ticks = axis.yaxis.get_major_locator()()
        assert sum(low <= tick <= high for tick in ticks) >= least
