"""Every figure of a trial: its marks are the records' numbers, and its theory holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from simbias.interfaces import Criterion, FittedBias, Quantity
from simbias.pictures import costs, forecast, phases, prediction_errors, rejections
from simbias.pictures.drawing import NoPictureError
from simbias.pictures.style import HARDWARE, NOMINAL, SIMULATION, png, symbol
from simbias.pictures.trial.compared import simulated, worst
from simbias.pictures.trial.errors import prediction_error, windows
from simbias.pictures.trial.limits import state_limits
from simbias.pictures.trial.phases import phase_pairs
from simbias.records import Array, Iteration
from simbias.study import Study


def lines(axes: Axes, color: str, marker: str = "None") -> list[Array]:
    """The data (k, 2) of the lines of a colour and marker."""
    found = [line for line in axes.lines if line.get_marker() == marker]
    return [line.get_xydata() for line in found if to_hex(line.get_color()).upper() == color]


def of(figure: Figure, ylabel: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_ylabel() == ylabel)


def test_limits_of_the_bongoboards_states(short: Study) -> None:
    """The norms of criteria 3 and 6 bound each angle and rate; the board's angle bounds none alone."""
    limits, task = short.task.limits, short.task
    expected = np.repeat([limits.distance, limits.speed], 3)
    np.testing.assert_allclose(state_limits(task), np.column_stack([-expected, expected]), rtol=1e-9)


def test_a_criterion_on_one_state_limits_it_alone(short: Study) -> None:
    """A board that is short enough leaves the wheel before it is too far: |r alpha_b| <= L / 2."""
    robot = replace(short.task.robot, board_length=0.3)
    task = type(short.task)(robot, short.task.limits, start(short))
    assert state_limits(task)[1] == pytest.approx([-1.0, 1.0])


def start(study: Study) -> object:
    from simbias.task.bongoboard import Start

    return Start(list(study.task.start_mean), 0.02)


def test_no_state_beyond_its_limits_is_allowed(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    task = of_point_mass[0].task
    np.testing.assert_allclose(state_limits(task), [[-1.0, 1.0], [-np.inf, np.inf]])
    assert isinstance(task.criteria[0], Criterion)


def test_phases_pair_states_with_their_rates(short: Study) -> None:
    assert phase_pairs(short.task) == [(0, 3), (1, 4), (2, 5)]


def test_phases_show_every_rollout(short: Study, trial: list[Iteration]) -> None:
    figure = phases(short, trial)
    for row, iteration in enumerate((trial[0], trial[-1])):
        for column, (i, rate) in enumerate(phase_pairs(short.task)):
            axes = figure.axes[3 * row + column]
            measured = [rollout.states[:, (i, rate)] for rollout in iteration.experiments]
            models = [rollout.states[:, (i, rate)] for rollout in simulated(short, iteration)]
            for color, expected in ((HARDWARE, measured), (SIMULATION, models)):
                for drawn, states in zip(lines(axes, color), expected, strict=True):
                    np.testing.assert_array_equal(drawn, states)
            assert axes.get_xlabel() == f"{symbol(short.task.states[i].name)} (rad)"
            assert axes.get_ylabel().endswith("(rad/s)")
            crosses = sum(rollout.failed_at is not None for rollout in iteration.experiments)
            assert len(lines(axes, HARDWARE, "X")) == crosses
    assert any(rollout.failed_at is not None for rollout in trial[0].experiments)


def test_phases_shade_what_is_beyond_a_limit_that_came_near(short: Study, trial: list[Iteration]) -> None:
    shaded = {}
    for axes in phases(short, trial).axes[:3]:
        edges = [patch.get_x() for patch in axes.patches if isinstance(patch, Rectangle)]
        edges += [patch.get_x() + patch.get_width() for patch in axes.patches if isinstance(patch, Rectangle)]
        shaded[axes.get_xlabel()] = edges
    reached = max(np.abs(r.states[:, :3]).max(axis=0).max() for r in trial[0].experiments)
    assert reached > 0.5 * short.task.limits.distance
    assert any(abs(edge) == pytest.approx(2.0) for edges in shaded.values() for edge in edges)


def test_a_task_without_rates_has_no_phases(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    study, iterations = of_point_mass
    task = type(study.task)()
    task.states = (Quantity("position", "m"), Quantity("mass", "kg"))
    with pytest.raises(NoPictureError, match="per second"):
        phases(replace(study, task=task), iterations)


def test_costs_are_those_of_the_records(short: Study, trial: list[Iteration]) -> None:
    by_iteration, pairs = costs(short, trial).axes
    measured = [[r.cost for r in iteration.experiments] for iteration in trial]
    models = [[r.cost for r in simulated(short, iteration)] for iteration in trial]
    assert [list(data[:, 1]) for data in lines(by_iteration, HARDWARE, "o")] == measured
    assert [list(data[:, 1]) for data in lines(by_iteration, SIMULATION, "o")] == models
    bars = [data for data in lines(by_iteration, SIMULATION) if len(data) == 2]
    assert [bar[0, 1] for bar in bars] == [iteration.predicted_cost for iteration in trial]
    for data, xs, ys in zip(lines(pairs, HARDWARE, "o"), models, measured, strict=True):
        np.testing.assert_array_equal(data, np.column_stack([xs, ys]))
    low, high = pairs.get_ylim()
    assert low < min(min(ys) for ys in measured) <= max(max(ys) for ys in measured) < high


class Perfect(FittedBias):
    """Knows how experiments go on: the residual of the recorded transition that is nearest."""

    def __init__(self, study: Study, iteration: Iteration) -> None:
        rollouts = iteration.experiments
        self._x = np.concatenate([r.states[:-1] for r in rollouts])
        self._u = np.concatenate([r.inputs for r in rollouts])
        after = np.concatenate([r.states[1:] for r in rollouts])
        steps = [study.nominal.step(x, u) for x, u in zip(self._x, self._u, strict=True)]
        self._residuals = after - np.array(steps)

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        raise NotImplementedError

    def correction(self, x: Array, u: Array) -> Array:
        return self._residuals[
            np.argmin(np.sum((self._x - x) ** 2, axis=1) + np.sum((self._u - u) ** 2, axis=1))
        ]


def test_a_perfect_bias_predicts_without_error(short: Study, trial: list[Iteration]) -> None:
    pieces = windows(short, trial[0], 20)
    errors = prediction_error(short, Perfect(short, trial[0]), pieces, [1, 5, 20])
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)
    assert errors.shape == (3, len(pieces.states), 6)


def test_without_bias_the_error_is_the_residual(short: Study, trial: list[Iteration]) -> None:
    """Eq. 6, one frame ahead; and many frames ahead as stepping through them one by one gives it."""
    pieces, zero = windows(short, trial[0], 30), short.bias.fit(short.no_data)
    one, many = prediction_error(short, zero, pieces, [1, 30])
    for piece, (states, inputs) in enumerate(zip(*pieces, strict=True)):
        x = states[0]
        for frame, u in enumerate(inputs):
            x = short.nominal.step(x, u)
            if frame == 0:
                np.testing.assert_allclose(one[piece], x - states[1], atol=1e-15)
        np.testing.assert_allclose(many[piece], x - states[30], rtol=1e-9, atol=1e-12)


def test_compiled_and_plain_corrections_give_the_same_errors(short: Study, trial: list[Iteration]) -> None:
    class Plain(FittedBias):
        predict = trial[-1].fitted_bias.predict
        correction = trial[-1].fitted_bias.correction

    Plain.__abstractmethods__ = frozenset()
    pieces = windows(short, trial[-1], 10)
    compiled, plain = (
        prediction_error(short, bias, pieces, [1, 10]) for bias in (trial[-1].fitted_bias, Plain())
    )
    np.testing.assert_allclose(compiled, plain, rtol=1e-3, atol=1e-7)
    assert (
        np.abs(compiled - prediction_error(short, short.bias.fit(short.no_data), pieces, [1, 10])).max()
        > 1e-5
    )


def test_error_marks_are_medians(short: Study, trial: list[Iteration]) -> None:
    figure = prediction_errors(short, trial, [1, 20])
    zero = short.bias.fit(short.no_data)
    for iteration in trial:
        pieces = windows(short, iteration, 20)
        for bias, color, marker in ((zero, NOMINAL, "s"), (iteration.fitted_bias, SIMULATION, "o")):
            errors = prediction_error(short, bias, pieces, [1, 20])
            for row, states in enumerate((slice(0, 3), slice(3, 6))):
                for column in range(2):
                    mark = lines(figure.axes[2 * row + column], color, marker)[iteration.index]
                    norms = np.linalg.norm(errors[column][:, states], axis=1)
                    assert mark[0, 1] == pytest.approx(np.median(norms))
    assert [axes.get_ylabel().split(" (")[-1] for axes in figure.axes[::2]] == ["rad)", "rad/s)"]


def test_experiments_shorter_than_the_horizon_are_left_out(short: Study, trial: list[Iteration]) -> None:
    cut = replace(
        trial[0].experiments[0],
        states=trial[0].experiments[0].states[:11],
        inputs=trial[0].experiments[0].inputs[:10],
        failed_at=10,
    )
    brief = replace(trial[0], experiments=(cut,))
    assert len(windows(short, brief, 10).states) == 1
    assert len(windows(short, brief, 11).states) == 0
    assert len(prediction_errors(short, [brief], [1, 20]).axes) == 2  # one horizon, two units
    with pytest.raises(NoPictureError, match="lasted"):
        prediction_errors(short, [brief], [11])


def test_no_error_at_all_can_be_shown(short: Study, trial: list[Iteration]) -> None:
    """Hardware that is the nominal model leaves nothing for a logarithmic scale."""
    exact = replace(trial[0], experiments=tuple(simulated(short, trial[0])))
    png(prediction_errors(short, [exact], [1, 5]))


def test_forecast_shows_the_experiment_and_what_was_foretold(short: Study, trial: list[Iteration]) -> None:
    figure, last = forecast(short, trial), trial[-1]
    measured = worst(last)
    corrected = short.simulate(last.optimum.parameters, last.fitted_bias, measured.states[0])
    nominal = short.simulate(last.optimum.parameters, None, measured.states[0])
    for i, axes in enumerate(figure.axes):
        for color, rollout in ((HARDWARE, measured), (SIMULATION, corrected), (NOMINAL, nominal)):
            (drawn,) = lines(axes, color)
            np.testing.assert_array_equal(drawn[:, 1], rollout.states[:, i])
        assert len(axes.collections) == 1


def test_nothing_learned_leaves_nothing_open(short: Study, trial: list[Iteration]) -> None:
    assert not any(axes.collections for axes in forecast(short, trial[:1]).axes)


def test_band_is_wide_where_the_learner_is_unsure(short: Study, trial: list[Iteration]) -> None:
    """It starts at the start, known for sure, and grows."""
    (band,) = forecast(short, trial).axes[0].collections
    (path,) = band.get_paths()
    at = path.vertices[:, 0]
    width = {t: np.ptp(path.vertices[np.isclose(at, t, atol=1e-3), 1]) for t in (at.min(), at.max())}
    assert width[at.min()] == pytest.approx(0.0, abs=1e-12)
    assert width[at.max()] > 1e-3


def test_rejections_count_every_sample(short: Study, trial: list[Iteration]) -> None:
    axes = rejections(short, trial).axes[0]
    bars = {container.get_label(): [bar.get_width() for bar in container] for container in axes.containers}
    assert bars["accepted"] == [len(iteration.selection.transitions) for iteration in trial]
    assert np.sum(list(bars.values()), axis=0).tolist() == [i.selection.sampled for i in trial]
    said = [text.get_text() for text in axes.texts]
    for iteration in trial:
        assert any(text.startswith(f"{len(iteration.data)} in D") for text in said)


def test_names_are_read_as_symbols() -> None:
    assert symbol("d_alpha_w") == r"$\dot{\alpha}_{w}$"
    assert symbol("theta") == r"$\theta$"
    assert symbol("board_angle") == "board angle"
