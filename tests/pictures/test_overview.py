"""The overview: what it says and shows of a trial, and what it does without."""

from dataclasses import replace

import numpy as np
import pytest
from figures import lines, texts
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pendulum import pendulum

from simbias.core.records import Iteration, Rollout
from simbias.learning.identification.identified import Identified
from simbias.pictures import NoPictureError, overview
from simbias.pictures.elements.style import HARDWARE, SIMULATION, label, symbol
from simbias.pictures.trial.comparison import policy_words
from simbias.trial.study import Study


def panel(figure: Figure, label: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_ylabel().startswith(label))


@pytest.fixture(scope="module")
def figure(short: Study, trial: list[Iteration]) -> Figure:
    return overview(short, trial)


def test_a_rate_is_named_as_one() -> None:
    names = ("d_theta_1", "d_pole_angle", "board_angle", "d")
    assert list(map(symbol, names)) == [r"$\dot{\theta}_{1}$", "rate of pole angle", "board angle", "d"]


def test_it_says_what_happened(short: Study, trial: list[Iteration], figure: Figure) -> None:
    """The worst experiments in words, every axis with its unit, the criterion that failed."""
    fallen, words = max(trial[0].experiments, key=lambda rollout: rollout.cost), texts(figure)
    criterion = next(c for c in short.task.criteria if c.name == fallen.failure)
    for sentence in (
        f"Policy from simulation alone: fails on hardware after {fallen.failed_at / 1000:.2f} s",
        "Policy after 2 hardware experiments: lasts all 1 s on hardware",
        "simulation: nominal model + learned bias (gp)",
        "hardware: pymunk, worst of 2",
        short.task.words(fallen.failure),
        "time (s)",
        "cost Z (dimensionless)",
        f"criterion\n{label(criterion)}",
    ):
        assert sentence in words


def test_its_layout_is_settled_before_it_is_drawn(figure: Figure) -> None:
    """Else labels may be cut off."""
    places = [axes.get_position().bounds for axes in figure.axes]
    figure.draw_without_rendering()
    np.testing.assert_allclose([axes.get_position().bounds for axes in figure.axes], places, atol=0.01)


def test_it_compares_from_the_same_starts(short: Study, trial: list[Iteration], figure: Figure) -> None:
    """Its lines are the measures of the records and of their simulation; so are the costs, one by one."""
    fallen = max(trial[0].experiments, key=lambda rollout: rollout.cost)
    index = next(i for i, c in enumerate(short.task.criteria) if c.name == fallen.failure)
    first = next(axes for axes in figure.axes if axes.get_xlabel() == "time (s)")
    bias = trial[0].model.bias
    for color, rollout in (
        (HARDWARE, fallen),
        (SIMULATION, short.simulate(fallen.parameters, bias, fallen.states[0])),
    ):
        (times, measures) = lines(first, color)[0].T
        np.testing.assert_allclose(times, 0.001 * np.arange(rollout.frames + 1))
        np.testing.assert_allclose(measures, short.task.measure(rollout.states)[:, index])
    costs = panel(figure, "cost Z (")
    measured = np.concatenate(lines(costs, HARDWARE, "o"))
    np.testing.assert_array_equal(measured[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(measured[:, 1], [r.cost for i in trial for r in i.experiments])
    expected = [
        short.simulate(r.parameters, i.model.bias, r.states[0]).cost for i in trial for r in i.experiments
    ]
    np.testing.assert_allclose(np.concatenate(lines(costs, SIMULATION, "o"))[:, 1], expected)


def test_the_cost_is_shown_where_nothing_failed(short: Study, trial: list[Iteration]) -> None:
    """It grows until it is that of the whole experiment; one that is too costly is no success."""
    costly = replace(trial[1].experiments[0], cost=345.6)
    last = replace(trial[-1], index=0, experiments=(costly,))
    shown = overview(short, [last])
    assert "too costly on hardware (Z = 346)" in texts(shown)
    (values,) = (data[:, 1] for data in lines(panel(shown, "cost Z so far"), HARDWARE) if len(data) > 2)
    assert values[-1] == trial[1].experiments[0].cost
    assert (np.diff(values) >= 0).all()
    names = [criterion.name.replace("_", " ") for criterion in short.task.criteria]
    assert not any(axes.get_ylabel().startswith(tuple(names)) for axes in shown.axes)


@pytest.mark.slow
def test_a_trial_of_one_iteration_and_a_method_without_search(
    short: Study, trial: list[Iteration], on_hardware: list[Iteration]
) -> None:
    """Its hardware has a failure of its own; hardware alone, and the policy of each iteration."""
    fallen = replace(trial[0].experiments[0], failure="the_physics_engine_blew_up")
    words = texts(overview(short, [replace(trial[0], experiments=(fallen,), total_experiments=1)]))
    assert "the physics engine blew up" in words
    assert "simulation alone" in words
    assert "learned bias" not in words
    known = Identified.of_prior(pendulum().nominal)  # by recordings
    assert trial[0].model is not None
    attached = replace(trial[0], model=replace(trial[0].model, nominal=known))
    assert policy_words(attached) == "Policy from the identified model alone"
    words = texts(overview(short, on_hardware))
    for index in (0, 1):
        assert f"Policy of iteration {index}: lasts all 1 s on hardware" in words
    assert "simulation" not in words
    with pytest.raises(NoPictureError, match="no policy was tried"):
        overview(short, [replace(on_hardware[0], experiments=())])


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_without_a_drawing_and_with_costs_far_from_one_it_has_room_for_all(
    of_point_mass: tuple[Study, list[Iteration]], factor: float
) -> None:
    """Headlines are above legends, and a narrow panel's ticks have short labels."""
    study, iterations = of_point_mass

    class Scaled(type(study.cost)):  # type: ignore[misc]
        max_cost = factor * study.cost.max_cost

        def of(self, rollout: Rollout) -> float:
            return factor * float(super().of(rollout))

    def scaled(iteration: Iteration) -> Iteration:
        made = tuple(replace(each, cost=factor * each.cost) for each in iteration.experiments)
        return replace(iteration, experiments=made)

    figure = overview(replace(study, cost=Scaled()), [*map(scaled, iterations)])
    figure.draw_without_rendering()
    left, right = figure.subfigs
    for block in left.subfigs:
        (words,), (axes,) = block.texts, block.axes
        assert words.get_window_extent().y0 > axes.get_legend().get_window_extent().y1
    (costs,) = right.axes
    assert costs.get_window_extent().width > 0.4 * right.bbox.width
    assert costs.get_yscale() == "log" or "(10" in costs.get_ylabel()
