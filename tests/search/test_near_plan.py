"""A search near a plan: its directions, and the optimum that it finds in them."""

from pathlib import Path

import numpy as np
import pytest

import simbias
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer.cma import Cma
from simbias.search.optimizer.ilqr import Shooting
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study

KNOTS, SEARCHED = 21, 4
NEAR = ["preset=[cartpole_trajectory,near_plan]", "policy.searched_knots=3", "optimizer.max_evaluations=64"]


@pytest.fixture(scope="module")
def study() -> Study:
    return simbias.load(["preset=cartpole_trajectory", "tracking=none", "task.horizon=100"])


@pytest.fixture
def planned(study: Study) -> tuple[Trajectory, Array]:
    policy = Trajectory(study.task, study.nominal, KNOTS, searched_knots=SEARCHED)
    return policy, np.random.default_rng(0).uniform(-1, 1, policy.n_parameters)


def test_inputs_and_gains_change_at_the_searched_knots_and_not_at_the_end(
    planned: tuple[Trajectory, Array], study: Study
) -> None:
    policy, theta = planned
    directions = policy.directions(theta)
    assert len(directions) == SEARCHED * (1 + 4)  # an input, and a gain of each state
    rows, changed = theta.reshape(KNOTS, -1), (theta + directions.sum(axis=0)).reshape(KNOTS, -1)
    before_end = np.interp(policy.times, policy.times[[0, -6, -1]], [1.0, 1.0, 0.0])[:, None]
    np.testing.assert_array_equal(policy.planned(theta + directions.sum(axis=0)), policy.planned(theta))
    np.testing.assert_allclose(changed[:, 4] - rows[:, 4], 0.2 * study.task.input_limit * before_end[:, 0])
    np.testing.assert_allclose(changed[:, 5:], rows[:, 5:] * (1 + 0.9 * before_end))
    assert not len(Trajectory(study.task, study.nominal, KNOTS).directions(theta))


def test_the_optimum_is_the_nearest_policy_in_these_directions(planned: tuple[Trajectory, Array]) -> None:
    policy, theta = planned
    z = np.random.default_rng(1).uniform(-0.5, 0.5, SEARCHED * 5)
    aim = theta + z @ policy.directions(theta)
    optimizer = Cma(initial_deviation=0.1, population=None, max_evaluations=4000, relative_tolerance=0.0)
    found = optimizer.minimize(
        lambda other: float(np.sum((other - aim) ** 2)),
        *policy.bounds,
        np.random.default_rng(2),
        candidates=[theta + 0.1, theta],
        directions=policy.directions,
    )
    np.testing.assert_allclose(found.parameters, aim, atol=1e-3)
    assert found.evaluations <= 4000 + 2


@pytest.mark.slow
def test_a_trial_searches_near_its_plan(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder has the policy itself: reading it back needs no plan."""
    short = [
        "tracking=none",
        "task.horizon=100",
        "task.hold=0.2",
        "method.max_iterations=1",
        "identification=none",
    ]
    presets = ["preset=cartpole_trajectory"], NEAR
    compared, searched = (run_trial(simbias.load([*preset, *short])).iterations[0] for preset in presets)
    assert searched.search.predicted_cost < compared.search.predicted_cost
    assert 3 < searched.search.optimum.evaluations <= 64 + 3
    near = simbias.load([*NEAR, *short])
    plans = (near.policy.planned(each.parameters) for each in (searched, compared))
    np.testing.assert_array_equal(*plans)
    made = run_trial(near, tmp_path / near.hash)
    monkeypatch.setattr(Shooting, "plan", None)
    for again in (made, read_trial(near, tmp_path / near.hash)):
        np.testing.assert_array_equal(again.iterations[0].parameters, searched.parameters)


def test_without_a_plan_it_is_one_line() -> None:
    """Also with a method that plans nothing."""
    for other in (["method.trajectories=0"], ["~method.target_cost", "method=ideal"]):
        with pytest.raises(ConfigError, match=r"^policy\.searched_knots: needs a plan"):
            run_trial(simbias.load([*NEAR, "tracking=none", *other]))


@pytest.mark.parametrize("wrong", [np.ones(3), np.ones((3, 2)), np.full((2, 3), np.nan)])
def test_directions_of_another_shape_are_refused(wrong: Array) -> None:
    optimizer = Cma(initial_deviation=0.1, population=None, max_evaluations=40, relative_tolerance=0.0)
    with pytest.raises(ValueError, match=r"directions: expected finite numbers of shape \(d, 3\), got shape"):
        optimizer.minimize(
            lambda theta: float(theta @ theta),
            -np.ones(3),
            np.ones(3),
            np.random.default_rng(0),
            candidates=[np.zeros(3)],
            directions=lambda theta: wrong,
        )
