"""Robots that follow a reference: planned on the model, and seen beside it."""

import numpy as np
import pytest
from figures import lines

import simbias
from simbias.core.records import Array
from simbias.pictures import NoPictureError, following
from simbias.pictures.elements.style import HARDWARE
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer.following import Following
from simbias.search.optimizer.ilqr import Shooting
from simbias.trial.steps import Stopwatch, iteration_record
from simbias.trial.study import Study

SHORT = ["task.horizon=100", "task.hold=0.5", "policy.knots=51", "identification=none", "tracking=none"]


@pytest.fixture(scope="module")
def robot() -> Study:
    return simbias.load(["preset=arm_eight", "bias=none", *SHORT])


def distances(study: Study, states: Array) -> Array:
    """Distances (T+1,) in m from the goal along states (T+1, n)."""
    return np.linalg.norm(study.task.error(states, study.task.time_step * np.arange(len(states))), axis=1)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_plan_follows_and_costs_what_the_cost_says(robot: Study) -> None:
    """It begins at rest, and its policy follows on the model; on the hardware not as well."""
    shooting = Shooting(robot.first_model(), robot.cost.goal_weights)
    plan = shooting.plan(np.random.default_rng(0))
    assert plan is not None
    assert distances(robot, robot.task.start_mean[None]) == pytest.approx([0.0], abs=1e-9)
    assert distances(robot, plan.states).max() < 0.02
    assert isinstance(robot.policy, Trajectory)
    policies = Following(robot.first_model(), robot.cost.goal_weights).policies(plan, robot.policy, [10.0])
    (theta,) = policies
    rollout = robot.simulate(theta)
    assert distances(robot, rollout.states).max() < 0.02
    seconds = robot.task.horizon * robot.task.time_step
    assert shooting._cost(rollout.states, rollout.inputs) == pytest.approx(0.5 * seconds * rollout.cost, 1e-3)
    lower, upper = robot.task.input_bounds
    assert (plan.inputs >= lower).all()
    assert (plan.inputs <= upper).all()
    experiment = robot.experiment(theta, np.random.default_rng(0))
    errors = [distances(robot, each.states).mean() for each in (rollout, experiment)]
    assert errors[1] > 3 * errors[0]
    tried = iteration_record(robot, 0, theta, (experiment,), 1, Stopwatch())
    plane, *over_time = following(robot, [tried]).axes
    aims = robot.task.aim(experiment.states)
    np.testing.assert_array_equal(lines(plane, HARDWARE)[0], aims)
    for axes, aim in zip(over_time, aims.T, strict=True):
        np.testing.assert_array_equal(lines(axes, HARDWARE)[0][:, 1], aim)


def test_a_goal_that_rests_has_no_such_picture() -> None:
    resting = simbias.load(["preset=cartpole", "tracking=none"])
    with pytest.raises(NoPictureError, match="does not move"):
        following(resting, [])
