"""Robots that move: they follow what is planned on the model, or swing up, as no linear policy can."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from figures import lines, texts
from mechanisms import cart_pole

import simbias
from simbias.core import Nominal, Task
from simbias.core.records import Array, Disturbance, Rollout
from simbias.cost.declared import Declared
from simbias.pictures import NoPictureError, following, overview
from simbias.pictures.elements.style import HARDWARE
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer.following import Following
from simbias.search.optimizer.ilqr import Shooting
from simbias.simulation.closed_loop import simulator
from simbias.simulation.goal import goal_held
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.diagnostics import of_experiments, of_goal, of_prediction
from simbias.trial.steps import Stopwatch, iteration_record
from simbias.trial.study import Study
from simbias.trial.summary import iteration_summary

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
    plan = shooting.plan(None)
    assert plan is not None
    assert distances(robot, robot.task.start_mean[None]) == pytest.approx([0.0], abs=1e-9)
    assert distances(robot, plan.states).max() < 0.02
    assert isinstance(robot.policy, Trajectory)
    policies = Following(robot.first_model(), robot.cost.goal_weights).policies(plan, robot.policy, [10.0])
    (theta,) = policies
    rollout = robot.simulate(theta)
    assert distances(robot, rollout.states).max() < 0.02
    seconds = robot.task.horizon * robot.task.time_step
    assert shooting._judged(rollout.states, rollout.inputs).cost == pytest.approx(
        0.5 * seconds * rollout.cost, 1e-3
    )
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


@pytest.mark.usefixtures("uncompiled")
def test_an_angle_that_wraps_is_drawn_beside_its_reference() -> None:
    moving = ["preset=pendulum_swingup", "policy=mlp", "task.goal={angle: pi + t, d_angle: 1}"]
    short = ["task.horizon=20", "task.hold=0.2", "bias=none", "identification=none", "tracking=none"]
    study = simbias.load([*moving, *short])
    theta, states = np.zeros(study.policy.n_parameters), np.tile([0.1 - np.pi, 0.0], (21, 1))
    made = Rollout(states, np.zeros((20, 1)), parameters=theta)
    tried = iteration_record(study, 0, theta, (made,), 1, Stopwatch())
    angle = lines(following(study, [tried]).axes[0], HARDWARE)[0][:, 1]
    np.testing.assert_allclose(angle, 0.1 + np.pi)


def test_a_goal_that_rests_has_no_such_picture() -> None:
    resting = simbias.load(["preset=cartpole", "tracking=none"])
    with pytest.raises(NoPictureError, match="does not move"):
        following(resting, [])


@pytest.mark.slow
def test_a_trial_swings_up_a_cart_pole_with_friction_and_a_weak_motor() -> None:
    """Shortened: one experiment an iteration, and fewer simulated policies. They are as in NumPy."""
    options = ["optimizer.max_evaluations=6000", "evaluation.rollouts=4", "budget.experiments=4"]
    study = simbias.load(["preset=cartpole_swingup", "tracking=none", "method.experiments=1", *options])
    last = list(study.run())[-1]
    assert last.succeeded
    assert last.search.predicted_cost < 0.5  # 1 is the cost of hanging
    (rollout,) = last.experiments
    held = np.abs(study.task.error(rollout.states, 0.0)[-51:, 1])  # of the angle in the last second
    assert rollout.states[0, 1] == pytest.approx(np.pi, abs=0.3)
    assert held.max() < 0.2
    uptime = study.task.uptime(rollout.states)
    assert 0.2 < uptime < 0.9
    assert iteration_summary(study, last, ())["metrics"]["experiments/uptime_min"] == uptime
    assert f"hardware: cartpole_swingup, uptime {uptime:.0%}" in texts(overview(study, [last]))
    start = study.task.start_mean
    T = study.task.horizon
    assert study.task.succeeds(np.tile(start, (T + 1, 1))) is False
    calm = Disturbance(np.zeros((T, 1)), np.zeros((T + 1, 4)))  # with noise, it is the loop of the search
    compiled = simulator(last.model, calm, study.cost).rollout(last.parameters, start)
    (plain,) = PlainSimulator([last.model], [None]).rollouts(last.parameters[None], start[None])
    np.testing.assert_allclose(compiled.states, plain.states, atol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_policy_that_does_not_swing_up_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    study = simbias.load(["preset=cartpole_swingup", "tracking=none"])
    (remark,) = of_prediction(np.zeros(study.policy.n_parameters), study.first_model(), study)
    missed = (
        "does not reach the goal in 5 s of simulation: in its last 1 s upright is 3.14 rad, not below 0.2"
    )
    assert f"{missed}; inputs are at their limits in 0% of" in remark.words
    *_, remark = of_prediction(study.policy.bounds[1], study.first_model(), study)
    assert "below which its regulator acts, is at its upper bound" in remark.words
    rooted = replace(study, cost=Declared(study.task, 1.0, 1.0, "sqrt(3 - angle)"))
    *_, remark = of_prediction(np.zeros(study.policy.n_parameters), study.first_model(), rooted)
    assert remark.words.startswith("cost.running is not finite at t = 0.02 s of this policy's simulation")
    rollout = study.simulate(np.zeros(study.policy.n_parameters))
    assert of_experiments((rollout,), study) == [  # on hardware it is told likewise
        "1 of 1 experiment missed the goal: in its last 1 s upright is 3.14 rad, not below 0.2"
    ]
    fallen = replace(rollout, inputs=rollout.inputs[:157], failed_at=157, failure="off_the_rail")
    (remark,) = of_goal(fallen, study.first_model())
    assert remark.words == "this policy fails in simulation, after 3.14 s: off the rail"
    words = []
    for last in (np.pi - 0.1, 0.3):  # it hardly moves, and comes nearer until the end
        states = np.zeros_like(rollout.states)
        states[:, 1] = np.linspace(np.pi, last, len(states))
        words += [remark.words for remark in of_goal(replace(rollout, states=states), study.first_model())]
    assert ["approaching, so the horizon may be too short" in each for each in words] == [False, True]
    balancing = simbias.load(["preset=cartpole", "tracking=none"])  # its cost says what success is
    still = np.zeros(balancing.policy.n_parameters)
    (remark,) = of_prediction(still, balancing.first_model(), balancing)
    assert re.fullmatch(r"this policy fails in simulation, from \d+ of 20 starts that .*", remark.words)
    unlimited = property(lambda task: (-task.input_limit, np.full(1, np.inf)))
    monkeypatch.setattr(type(study.task), "input_bounds", unlimited)
    (remark,) = of_prediction(np.zeros(study.policy.n_parameters), study.first_model(), study)
    assert "inputs are at their limits in 0% of" in remark.words
    assert Task.missed(study.task, np.zeros((101, 4))) == (
        "at its end off by position 0 m, angle 0 rad, d_position 0 m/s, d_angle 0 rad/s"
    )


def test_a_plan_that_misses_the_goal_is_told_why() -> None:
    """By the limits that the planner has, and by what the goal and its conditions need."""
    options = ["method=trajectory", "policy=trajectory", "~policy.units", "policy.bound=1000"]
    options += ["policy.knots=51", "policy.observer=none", "identification=none", "tracking=none"]

    def told(states: Array, *more: str) -> str:
        study = simbias.load(["preset=pendulum_swingup", *options, *more])
        frames = len(states) - 1
        inputs = np.where(np.arange(frames) < frames / 2, 0.8, 0.5)[:, None] * study.task.input_limit
        (remark,) = of_goal(Rollout(states, inputs), study.first_model(), planned=True)
        return remark.words.partition("; inputs ")[2]

    spinning = "+task.success.spins={value: d_angle, above: 1.0}"
    T = simbias.load(["preset=pendulum_swingup", *options]).task.horizon
    nearer = np.stack([np.linspace(np.pi, 0.3, T + 1), np.zeros(T + 1)], axis=1)
    limits = "are at the planner's limits (80% of the task's) in 50% of the frames"
    approaching = "; it was still approaching, so the horizon may be too short"
    more = "; a larger method.trajectories tries more plans"
    assert told(nearer) == limits + approaching + more
    study = simbias.load(["preset=pendulum_swingup", *options])
    missing = Rollout(nearer, np.zeros((T, 1)))
    (remark,) = of_goal(missing, study.first_model(), planned=True, weighed=False)
    assert remark.words.endswith(
        "the plan has default weights, as this cost gives none: set them with cost=tracking"
    )
    assert told(nearer, "task.goal={angle: pi/2, d_angle: 0}") == f"{limits}, and cannot hold the goal"
    assert told(nearer, spinning) == limits + more  # nothing leads there
    reached = nearer * 0.5 ** np.linspace(0.0, 20.0, T + 1)[:, None]
    assert told(reached, spinning) == limits + more
    at_last = np.stack([np.linspace(np.pi, 0.0, T + 1), np.zeros(T + 1)], axis=1)
    assert told(at_last).endswith(
        "; the plan is there at the end only: with policy.resting (s), it rests there before the end"
    )
    within = "+task.inputs.torque.lower=1.5"  # at least 80% of it: a plan's inputs may not be smaller
    assert told(nearer, within).startswith("are at the planner's limits (80% of the task's) in 100%")
    searched = ["preset=pendulum_swingup", *options, "method=direct_search", "~method.target_cost"]
    study = simbias.load(searched)
    (remark,) = of_prediction(np.zeros(study.policy.n_parameters), study.first_model(), study)
    assert remark.words.endswith("; inputs are at their limits in 0% of the frames")  # nothing was planned


@pytest.mark.parametrize(
    ("states", "inputs", "goal", "slopes", "is_held"),
    [
        ({"z": "m", "v": "m/s"}, (0.0, 5.0), {"z": "1"}, lambda x, u: [x[1], 2 * u[0] - 9.8], True),
        ({"z": "m", "v": "m/s"}, (0.0, 4.5), {"z": "1"}, lambda x, u: [x[1], 2 * u[0] - 9.8], False),
        ({"level": "m"}, (0.0, 1.0), {"level": "0.05"}, lambda x, u: [u[0] - np.sqrt(x[0])], True),
        ({"heat": "K"}, (0.0, 100.0), {"heat": "4"}, lambda x, u: [u[0] - 0.5 * x[0]], True),
        (
            {"z": "m", "v": "m/s", "rotor": "rad/s"},
            (0.0, 400.0),
            {"z": "1"},
            lambda x, u: [x[1], 1e-3 * x[2] ** 2 - 9.8, 20 * (u[0] - x[2])],
            True,
        ),
        (
            {"z": "m", "v": "m/s"},
            (0.0, 4.5),
            {"z": "1"},
            lambda x, u: [x[1], 2 * u[0] - 9.8 + (x[0] < 1) * (500 * (1 - x[0]) - 20 * x[1])],
            True,
        ),
    ],
    ids=["near the limit", "too weak", "no slope", "near no input", "a rotor turns", "on a floor"],
)
def test_a_goal_is_held_near_limits_and_with_rates_that_it_leaves_free(
    states: dict[str, str], inputs: tuple[float, float], goal: dict[str, str], slopes: Any, is_held: bool
) -> None:
    """A success elsewhere says that no goal is meant."""
    (lower, limit), first = inputs, next(iter(states))
    drive = {"unit": "N", "limit": limit, "lower": lower}
    units = {name: {"unit": unit} for name, unit in states.items()}
    options = {"states": units, "inputs": {"drive": drive}, "failure": None, "hold": 0.5}
    near = {"near": {"value": f"abs({first}_error)", "below": 0.1}}
    task = cart_pole(**options, goal=goal, success=near)

    class Slopes(Nominal):
        def step(self, x: Array, u: Array) -> Array:
            moved = slopes(np.moveaxis(x, -1, 0), np.moveaxis(u, -1, 0))
            return x + task.time_step * np.stack(moved, axis=-1)

    assert goal_held(task, Slopes()) == is_held
    elsewhere = {"far": {"value": first, "above": 100.0}}
    assert goal_held(cart_pole(**options, goal=goal, success=elsewhere), Slopes())


@pytest.mark.slow
def test_late_motors_are_met_before_any_experiment() -> None:
    study = simbias.load(["preset=cartpole_swingup", "tracking=none"])
    names = [parameter.name for parameter in study.first_model().nominal.parameters]
    assert names[-2:] == ["force.gain", "force.delay"]
    without = simbias.load(["preset=cartpole_swingup", "tracking=none", "identification=none"])
    assert without.first_model().nominal is without.nominal
