"""Trajectories by iterative LQR, and the policies that follow them."""

from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from in_numpy import simulate_in_numpy
from mechanisms import declared, shipped_task
from models import with_values
from scipy.linalg import solve_discrete_are

import simbias
from simbias.config.components import construct
from simbias.core import FittedBias, StudyWarning, Task
from simbias.core.errors import ConfigError
from simbias.core.records import Transitions
from simbias.learning.bias.none import ConstantBias, NoBias
from simbias.policy.trajectory import Trajectory
from simbias.search.optimizer import ilqr
from simbias.search.optimizer.following import STIFFER, Following
from simbias.search.optimizer.ilqr import Shooting, _unfailing
from simbias.search.optimizer.trajectory_candidates import trajectory_candidates
from simbias.simulation.closed_loop import simulator
from simbias.simulation.goal import goal_along, goal_at_rest
from simbias.simulation.linearization import linearization, regulation, solved
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.run import run_trial
from simbias.trial.study import Study

A = np.array([[1.0, 0.1], [0.3, 0.98]])
B = np.array([[0.0], [0.1]])
M = np.concatenate([A, B], axis=1)


@pytest.fixture(scope="module")
def cartpole() -> Study:
    """In 4 s, of frames twice as long."""
    coarse = ["task.time_step=0.04", "task.horizon=100", "task.hold=0.5", "policy.knots=51"]
    return simbias.load(["preset=cartpole_trajectory", "identification=none", "tracking=none", *coarse])


def test_after_many_frames_the_gains_are_those_of_the_riccati_equation() -> None:
    Q, R, many = np.diag([2.0, 1.0]), np.array([[0.5]]), 300
    _, K, V = solved(regulation(np.tile(M, (many, 1, 1)), Q, R, Q), 2)
    S = solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(V, S, rtol=1e-9)
    np.testing.assert_allclose(K[0], np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A), rtol=1e-9)


def test_gains_are_of_what_is_seen_and_steps_end_at_limits() -> None:
    problem = regulation(np.tile(M, (50, 1, 1)), np.eye(2), np.eye(1), np.eye(2))
    problem = problem._replace(w=np.tile([5.0, 0.0, 0.0], (50, 1)))
    k, K, _ = solved(problem, 1)
    assert (K[:, :, 1] == 0.0).all()
    assert (K[:, :, 0] != 0.0).sum() > 40
    limited, gains, _ = solved(problem, 1, (np.full((50, 1), -0.5), np.full((50, 1), 0.5)))
    assert np.abs(k).max() > 0.5
    np.testing.assert_allclose(np.abs(limited).max(), 0.5)
    assert (gains[np.abs(limited) == 0.5] == 0.0).all()


@pytest.mark.slow
def test_a_cart_pole_is_swung_up_and_the_policy_does_it_again(
    cartpole: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From other starts, too; the policy of the plan ends at rest, with gains that hold there."""
    model = cartpole.first_model()
    shooting = Shooting(model)
    plan = shooting.plan(np.random.default_rng(0))
    assert cartpole.task.succeeds(plan.states)
    assert np.abs(plan.inputs).max() <= cartpole.task.input_limit
    (theta,) = Following(model).policies(plan, cartpole.policy, [10.0])
    simulate_in_numpy(monkeypatch)  # for a few rollouts
    for seed in range(3):
        start = cartpole.task.draw_start(np.random.default_rng(seed))
        assert cartpole.passes(cartpole.simulate(theta, start=start)), seed
    last = theta.reshape(-1, 9)[-1]
    assert cartpole.task.error(last[:4], 4.0) == pytest.approx(np.zeros(4), abs=1e-3)
    assert shooting.along_knots(plan, cartpole.policy.times).cost < 1.1 * plan.cost
    monkeypatch.setattr(Shooting, "plan", lambda self, rng: plan)
    few = replace(model, policy=Trajectory(cartpole.task, model.nominal, 11))
    with pytest.warns(
        StudyWarning, match=r"followed with policy.knots=11 it .*; policy.knots=101 has one per frame"
    ):
        next(trajectory_candidates([few], 1))


ELBOW, SHOULDER = {"friction_2": 0.12}, {"friction_1": 0.0127}  # N m, of arctan: pi/2 times as much


def rubbing(**friction: float) -> Following:
    """What follows plans of an acrobot whose joints rub, planned as they slide."""
    study = simbias.load(["preset=acrobot_trajectory", "tracking=none", "task.horizon=200"])
    return Following(study.model(None, with_values(study.nominal, **friction)), None, sliding=True)


@pytest.mark.slow
def test_inputs_overcome_the_friction_of_their_own_joint() -> None:
    following, rng = rubbing(**ELBOW), np.random.default_rng(0)
    x, u = rng.normal(0.0, [1.0, 1.0, 3.0, 3.0], (20, 4)), rng.uniform(-3.0, 3.0, (20, 1))
    asked = u + following._compensation(x, u, 0)
    np.testing.assert_allclose(following._nominal.step(x, asked), following.sliding.step(x, u), atol=2e-3)
    assert np.abs(following._nominal.step(x, u) - following.sliding.step(x, u)).max() > 0.05


@pytest.mark.slow
def test_small_gains_count_on_the_friction_of_a_joint_without_a_motor() -> None:
    """They bring an acrobot nearer to rest than a regulator of sliding joints does."""
    zero, u_0 = np.zeros(4), np.zeros(1)
    assert not rubbing(**ELBOW)._for_friction(zero, u_0, 100.0).any()
    following = rubbing(**ELBOW, **SHOULDER)
    beside = following._for_friction(zero, u_0, 100.0)
    A, B = linearization(following.sliding, zero, u_0, np.array([6.0]))
    R = 100.0 * np.array([[6.0**-2]])
    S = solve_discrete_are(A, B, np.eye(4), R)
    soft = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
    assert np.linalg.norm(soft + beside) == pytest.approx(STIFFER * np.linalg.norm(soft), rel=0.01)
    ends = []
    for small in (0.0, 0.6):
        x, path = np.array([0.01, 0.0, 0.0, 0.0]), []
        for _ in range(1200):
            x = following._nominal.step(x, np.clip(-soft @ x - np.clip(beside @ x, -small, small), -6.0, 6.0))
            path.append(x)
        ends.append(np.abs(path[-300:]).max(axis=0))
    assert (ends[1][:2] < 0.5 * ends[0][:2]).all()


class Wrecking(NoBias):
    """What it learns throws a cart-pole off its rail."""

    def fit(self, transitions: Transitions) -> FittedBias:
        size = 10.0 if len(transitions.residuals) else 0.0
        return ConstantBias(np.full(4, size), np.zeros(4))


NEAR = ["preset=cartpole_trajectory", *(f"{group}=pendulum_swingup" for group in ("task", "cost"))]
NEAR += ["nominal=pendulum", "hardware=pendulum", "identification=none", "tracking=none", "policy.knots=51"]
NEAR += ["task.states.angle.mean=0.3", "task.time_step=0.04", "task.horizon=50"]  # 2 s, of a lean


@pytest.mark.slow
def test_a_plan_rests_at_the_goal_for_the_seconds_that_are_left_to_it(
    uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ilqr, "ITERATIONS", 15)
    study = simbias.load([*NEAR, "policy.resting=1.0"])
    theta = next(trajectory_candidates([study.first_model()], 1))
    rows = theta.reshape(51, -1)
    assert np.abs(rows[20, :2]).max() > 1e-4  # on its way
    np.testing.assert_allclose(rows[25:, :3], 0.0, atol=1e-9)
    assert (rows[25:, 3:] == rows[-1, 3:]).all()
    assert (rows[20, 3:] != rows[-1, 3:]).all()
    rollout = study.simulate(theta, start=study.task.start_mean)
    assert rollout.failed_at is None
    assert np.abs(rollout.states[25:, 0]).max() < 0.05


@pytest.mark.slow
def test_patient_plans_are_improved_for_longer(uncompiled: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ilqr, "ITERATIONS", 1)
    monkeypatch.setattr(ilqr, "PATIENT_ITERATIONS", 5)
    study = simbias.load([*NEAR, "method.max_iterations=1", "method.patient_plans=true"])
    model, weights = study.first_model(), study.cost.goal_weights
    rngs = (np.random.default_rng(0) for _ in range(2))
    hasty, patient = (Shooting(model, weights, False, p).plan(next(rngs)).cost for p in (False, True))
    assert patient < hasty
    (last,) = run_trial(study).iterations
    candidates = trajectory_candidates([model], study.method.trajectories, weights, patient=True)
    assert min(np.abs(theta - last.parameters).max() for theta in candidates) < 1e-9


def test_a_goal_of_outputs_that_determines_the_states_at_rest_is_where_a_policy_ends() -> None:
    outputs = {"hook": {"value": "position + 0.5 * sin(angle)"}, "lean": {"value": "2 * angle"}}

    def rests(near: float, **goal: str) -> np.ndarray | None:
        return goal_at_rest(declared(outputs=outputs, goal=goal), np.array([near, 0.3, 0.2, -0.1]))

    for near in (0.0, 0.7):
        np.testing.assert_allclose(rests(near, hook="0.25", lean="0"), [0.25, 0, 0, 0], atol=1e-9)
        assert rests(near, hook="0.25") is None  # anywhere between position and angle
        assert rests(near, hook="0.1 * t", lean="0") is None
    np.testing.assert_array_equal(goal_at_rest(declared(), np.ones(4)), np.zeros(4))


def test_a_goal_that_wraps_is_planned_for_the_shorter_way() -> None:
    config = shipped_task("pendulum_swingup")
    for start, goal, ends in (
        (3.0, "-3.0", [2 * np.pi - 3.0] * 2),
        (3.0 - 4 * np.pi, "-3.0", [-3.0 - 2 * np.pi] * 2),
        (np.pi, "0.0", [0.0, 0.0]),  # as far to either side: it stays
        (3.0, "atan2(sin(3.0 + t), cos(3.0 + t))", [3.0, 5.0]),
    ):
        angle, goals = config["states"]["angle"] | {"mean": start}, {"angle": goal, "d_angle": 0}
        changes = {"states": config["states"] | {"angle": angle}, "goal": goals, "horizon": 100}
        along = goal_along(construct({**config, **changes}, Task, "task"))[:, 0]
        np.testing.assert_allclose(along[[0, -1]], ends)
        assert np.abs(np.diff(along)).max() < 0.1


@pytest.mark.slow
def test_where_all_random_inputs_fail_a_plan_begins_at_rest(uncompiled: None) -> None:
    """A pole that falls within a second unless it is held."""
    study = simbias.load(["preset=cartpole", "policy=trajectory", "task.horizon=80", "tracking=none"])
    shooting = Shooting(study.first_model())
    assert shooting.plan(np.random.default_rng(0)) is None
    theta = next(trajectory_candidates([study.first_model()], 1))
    assert study.passes(study.simulate(theta))


@pytest.mark.slow
def test_to_a_goal_that_moves_one_plan_begins_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = list[np.random.Generator | None]()
    monkeypatch.setattr(Shooting, "plan", lambda self, rng: begun.append(rng))
    moving = simbias.load(["preset=arm_eight", "tracking=none"])
    with pytest.raises(ConfigError, match=r"the model fails from its start \(.*\), whichever inputs"):
        next(trajectory_candidates([moving.first_model()], 3))
    assert begun == [None]


@pytest.mark.slow
def test_a_plan_leads_over_such_that_fail(tmp_path: Path) -> None:
    """A pendulum spins after a reference; the first trajectories are faster than the task allows."""
    weak = resources.files(simbias) / "robots/mujoco/models/pendulum.xml"
    file = tmp_path / "strong.xml"
    file.write_text(weak.read_text().replace("-2.5 2.5", "-20 20"))
    task = ["task.horizon=100", "task.inputs.torque.limit=20", "task.failure.speed.above=14", "task.hold=0.5"]
    goal = ["task.goal={angle: 'pi + 3*t**2'}", "cost=tracking", "~cost.error_weights.velocity"]
    policy = ["policy=trajectory", "~policy.units", "policy.bound=1000", "policy.knots=51"]
    others = ["identification=none", "method=trajectory", "policy.observer=none"]
    others += [f"{group}.file={file}" for group in ("nominal", "hardware")]
    study = simbias.load(["preset=pendulum_swingup", "tracking=none", *task, *goal, *policy, *others])
    shooting = Shooting(study.first_model(), study.cost.goal_weights)
    plan = shooting.plan(None)
    assert study.task.failure(plan.states[-1]) is None
    error = plan.states[:, 0] - np.pi - 3 * (study.task.time_step * np.arange(101)) ** 2
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize("limit", [1.0, 0.1, 0.03])
def test_weak_motors_do_not_end_a_plan_early(limit: float) -> None:
    """A hanging pendulum has to swing; the first steps, with much damping, hardly begin to."""
    task = ["task.horizon=100", f"task.inputs.torque.limit={limit}", "task.hold=0.5"]
    goal = ["task.goal={angle: '0.3*sin(2*t)'}", "cost=tracking", "~cost.error_weights.velocity"]
    policy = ["policy=trajectory", "~policy.units", "policy.bound=1000", "policy.knots=51"]
    others = ["identification=none", "method=trajectory", "policy.observer=none"]
    study = simbias.load(["preset=pendulum_swingup", "tracking=none", *task, *goal, *policy, *others])
    plan, patient = (
        Shooting(study.first_model(), study.cost.goal_weights, patient=longer) for longer in (False, True)
    )
    rest, cost, least = plan._rest().cost, plan.plan(None).cost, patient.plan(None).cost
    assert rest - cost > 0.9 * (rest - least) > 0.0


@pytest.mark.slow
def test_a_plan_keeps_within_limits_of_failure() -> None:
    """A cart follows a reference whatever its pole does, which the cost leaves free but may not fall."""
    task = ["task.time_step=0.04", "task.horizon=75", "task.states.angle.mean=0.0"]
    task += [
        "task.goal={position: '0.4*sin(2*t)**2'}",
        "+task.failure.falls={value: 'abs(angle)', above: 0.3, unit: rad, words: it falls}",
    ]
    task += ["~task.success.upright", "task.success.in_the_middle.below=0.05"]
    others = ["cost=tracking", "~cost.error_weights", "+cost.error_weights={position: 10.0}"]
    others += ["policy.knots=38", "identification=none", "tracking=none"]
    study = simbias.load(["preset=cartpole_trajectory", *task, *others])
    model = study.first_model()
    shooting = Shooting(model, study.cost.goal_weights)
    without = Shooting(replace(model, task=_unfailing(study.task)), study.cost.goal_weights)
    free, plan = without._from_rest(), shooting.plan(None)
    assert (study.task.violated(free.states) >= 0).any()
    assert (study.task.violated(plan.states) < 0).all()
    assert plan.cost < 2.0 * free.cost
    theta = next(shooting.following.policies(plan, study.policy, [1.0]))
    rollout = simulator(model).rollout(theta, study.task.start_mean + 0.01)
    assert rollout.failed_at is None


@pytest.mark.slow
def test_a_rest_that_cannot_be_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"resting: expected less than the horizon's 2 s, got 2 s"):
        simbias.load([*NEAR, "policy.resting=2.0"])
    moving = simbias.load(["preset=arm_eight", "tracking=none", "policy.resting=0.5"])
    with pytest.raises(ConfigError, match=r"^policy\.resting: must be 0: a plan cannot rest"):
        run_trial(moving)  # before it begins


@pytest.mark.slow
def test_where_a_correction_lets_no_plan_exist_it_is_of_the_model_without(
    uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ilqr, "ITERATIONS", 2)
    monkeypatch.setattr(ilqr, "MARGINS", (0.5,))
    short = ["task.horizon=20", "task.hold=0.2", "policy.knots=21", "optimizer.max_evaluations=1"]
    cartpole = simbias.load(["preset=cartpole_trajectory", "identification=none", "tracking=none", *short])
    model = cartpole.first_model()
    wrecked = replace(model, bias=ConstantBias(np.full(4, 10.0), np.zeros(4)))
    with pytest.raises(ConfigError, match=r"the model fails from its start.*: force from -10 to 10 N"):
        next(trajectory_candidates([wrecked], 1))
    (first, second) = (list(trajectory_candidates(models, 1)) for models in ([wrecked, model], [model]))
    np.testing.assert_array_equal(first, second)
    study = replace(cartpole, bias=Wrecking(), method=ModelBased(trajectories=1, max_iterations=2))
    before, after = run_trial(study).iterations
    np.testing.assert_array_equal(after.parameters, before.parameters)
    assert after.search.predicted_cost > before.search.predicted_cost


@pytest.mark.slow
def test_a_plan_that_is_refuted_and_misses_the_goal_is_not_the_next_one(
    uncompiled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shooting, "plan", Shooting._first)  # random inputs, which miss it
    models = [simbias.load([*NEAR, "task.hold=0.5", "task.states.angle.mean=2.5"]).first_model()]
    others = [[], [np.zeros(models[0].policy.n_parameters)]]
    first, again = (list(trajectory_candidates(models, 1, None, refuted)) for refuted in others)
    np.testing.assert_array_equal(first, again)
    other = list(trajectory_candidates(models, 1, None, [first[1]]))
    assert np.abs(other[0] - first[0]).max() > 1e-3
    monkeypatch.setattr(type(models[0].task), "succeeds", lambda self, states: True)
    np.testing.assert_array_equal(list(trajectory_candidates(models, 1, None, [first[1]])), first)


def test_without_a_policy_that_follows_it_is_one_line(cartpole: Study) -> None:
    other = simbias.load(["preset=cartpole", "tracking=none"])
    with pytest.raises(ConfigError, match="OutputFeedback follows no trajectory; policy=trajectory does"):
        next(trajectory_candidates([other.first_model()], 1))
    with pytest.raises(ConfigError, match=r"^method\.trajectories: OutputFeedback follows no trajectory"):
        run_trial(replace(other, method=ModelBased(trajectories=1)))  # before it begins
    assert not list(trajectory_candidates([other.first_model()], 0))
