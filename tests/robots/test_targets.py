"""Targets: drawn with each start, known to policy and cost; not a robot's, not learned, not noisy."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from errors import one_line
from interpreted import interpreted
from mechanisms import declared as cart_pole

import simbias
from simbias.core import Hardware, Policy, StudyWarning, Task
from simbias.core.records import Array, Rollout, Transitions
from simbias.cost.tracking import Tracking
from simbias.lab.checked_hardware import CheckedHardware
from simbias.lab.requests.folder import files
from simbias.policy.network import Network
from simbias.robots.declared.task import Declared
from simbias.search.evaluation.nominal_start import NominalStart
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.study import Study

TARGETS = {
    "place": {"unit": "m", "kind": "position", "uniform": [0.1, 0.5]},
    "pace": {"unit": "1/s", "mean": 2.0},
}
OUTPUTS = {"off": {"value": "position - place"}, "angle": {"value": "angle"}, "d_angle": {"value": "d_angle"}}
TO_PLACE = {
    "targets": TARGETS,
    "outputs": OUTPUTS,
    "goal": {"position": "place * cos(pace * t)", "angle": "0"},
}
START = np.array([0.01, -0.02, 0.03, 0.04, 0.3, 1.5])


def declared(**changes: Any) -> Declared:
    """The cart-pole's task, its cart to oscillate about the middle by a distance that is drawn."""
    return cart_pole(**TO_PLACE | changes)


@pytest.fixture(scope="module")
def study() -> Study:
    """Of that task, in NumPy's hands."""
    made = simbias.load(["preset=cartpole", "tracking=none", "identification=none", "bias=mean"])
    task = declared()
    cost = Tracking(task, error_weights={"position": 1.0, "angle": 1.0}, max_cost=1.0, failure_weight=10.0)
    policy = Network(task, made.nominal, units=2, errors=True, observer="filter")
    return replace(made, task=task, cost=cost, policy=policy)


def thetas(study: Study, count: int) -> Array:
    return np.random.default_rng(0).uniform(-0.3, 0.3, (count, study.policy.n_parameters))


def test_a_task_draws_them_and_a_robot_does_not_know_them() -> None:
    task = declared()
    x = np.array([task.draw_start(rng) for rng in np.random.default_rng(0).spawn(200)])
    assert [state.name for state in task.states[-2:]] == ["place", "pace"]
    assert 0.1 < x[:, 4].min() < 0.11
    assert 0.49 < x[:, 4].max() < 0.5
    assert set(x[:, 5]) == {2.0}
    assert task.without_targets.states == task.states[:4]
    assert task.with_horizon(7).without_targets.horizon == 7
    np.testing.assert_array_equal(task.without_targets.measure(x[:, :4]), task.measure(x))
    np.testing.assert_array_equal(
        task.without_targets.draw_start(np.random.default_rng(3)),
        task.draw_start(np.random.default_rng(3))[:4],
    )
    plain = cart_pole()
    assert plain.without_targets is plain


def test_a_goal_and_outputs_use_them() -> None:
    task, t = declared(), np.array([0.0, 0.7])
    x = np.tile(START, (2, 1))
    np.testing.assert_allclose(task.error(x, t)[:, 0], 0.01 - 0.3 * np.cos(1.5 * t))
    np.testing.assert_allclose(task.error(START, 0.7), task.error(x, t)[1])
    np.testing.assert_allclose(task.reference(t)[:, 0], 0.3 * np.cos(2.0 * t))  # at their means
    assert task.output(START)[0] == pytest.approx(0.01 - 0.3)


def test_they_have_no_noise(study: Study) -> None:
    variances = {"position_variance": 0.01, "velocity_variance": 0.01}
    noise = Noise(study.task, variances).draw(np.random.default_rng(0))
    assert noise.sensors.shape[1] == 6
    assert noise.sensors[:, :4].all(axis=0).any()
    assert not noise.sensors[:, 4:].any()
    with pytest.raises(ValueError, match="no noise is called place_variance"):
        Noise(study.task, {"place_variance": 1.0})


@pytest.mark.slow
def test_compiled_rollouts_are_the_plain_ones(study: Study) -> None:
    rng = np.random.default_rng(0)
    data = Transitions(rng.standard_normal((9, 5)), 1e-3 * rng.standard_normal((9, 4)))
    noise = Noise(study.task, {"velocity_variance": 0.01}).draw(rng)
    some, starts = thetas(study, 4), np.array([study.task.draw_start(each) for each in rng.spawn(4)])
    model = study.model(study.bias.fit(data))
    plain = PlainSimulator([model], [noise])
    with interpreted():
        compiled = CompiledSimulator.of(model, noise, study.cost)
        assert compiled is not None
        made, (costs, _) = compiled.rollouts(some, starts), compiled.costs(study.cost, some, starts)
    for one, other in zip(made, plain.rollouts(some, starts), strict=True):
        frames = min(40, one.frames)
        np.testing.assert_allclose(one.states[:frames], other.states[:frames], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(one.states[:, 4:], np.tile(one.states[0, 4:], (one.frames + 1, 1)))
    expected, _ = plain.costs(study.cost, some, starts)
    np.testing.assert_allclose(costs, expected, rtol=1e-3)


class Still(Hardware):
    """A robot that stands where it was put, whatever its inputs."""

    def __init__(self, task: Task) -> None:
        self._task = task

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        assert start.shape == (4,)
        controller = policy.controller(theta, self._task.time_step)
        states = np.tile(start, (self._task.horizon + 1, 1))
        return Rollout(states, np.array([controller(x) for x in states[:-1]]), measured=states)


@pytest.fixture
def still(study: Study) -> Study:
    return replace(study, hardware=Still(study.task.without_targets))


def test_a_hardware_has_none_and_its_policy_knows_them(still: Study) -> None:
    (theta,) = thetas(still, 1)
    made = still.experiment(theta, np.random.default_rng(0), START)
    np.testing.assert_array_equal(made.states, np.tile(START, (still.task.horizon + 1, 1)))
    assert made.measured is not None
    np.testing.assert_array_equal(made.measured, made.states)
    controller = still.policy.controller(theta, still.task.time_step)
    np.testing.assert_allclose(made.inputs, [controller(x) for x in made.states[:-1]])
    checked = CheckedHardware(still.hardware, still.task)
    assert checked.run(still.policy, theta, START, np.random.default_rng(0)).states.shape[1] == 6


@pytest.mark.slow
@pytest.mark.usefixtures("plain_predictions")
def test_nothing_is_learned_of_them(still: Study) -> None:
    """What is learned is what the robot's own states say."""
    made = still.experiment(thetas(still, 1)[0], np.random.default_rng(0), START)
    own = made.of_states(4)
    selection, same = still.select([made], still.nominal), still.samples.select([own], still.nominal)
    assert selection.transitions.inputs.shape[1] == 4 + 1
    np.testing.assert_array_equal(selection.transitions.residuals, same.transitions.residuals)
    quick = ["identification.starts=2", "identification.rounds=1", "identification.evaluations=2"]
    learner = replace(still, identification=simbias.load(["preset=acrobot", *quick]).identification)
    assert np.shape(learner.identified([made]).step(START[:4], np.zeros(1))) == (4,)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_who_is_asked_is_told_a_robots_start_and_a_policy_that_knows_them(still: Study) -> None:
    two = simbias.load(["optimizer.max_evaluations=2"]).optimizer
    asking = replace(still, optimizer=two, evaluation=NominalStart(still.task))
    request = asking.ask()
    assert request is not None
    assert request.start.shape == (4,)
    law = request.policy.law(request.theta)
    assert 0.1 < law.numbers["targets"][0] < 0.5
    assert law.words.endswith(f"; targets: place = {law.numbers['targets'][0]:g} m, pace = 2 1/s")
    assert f"  place = {law.numbers['targets'][0]:g} m\n" in files(request)["README.txt"]
    assert request.content()["policy"]["class"] == type(still.policy).__name__
    rollout = Still(still.task.without_targets).run(
        request.policy, request.theta, request.start * [1, 1, 0, 0], np.random.default_rng(0)
    )
    asking.tell(rollout)
    asking.ask()
    (told, *_) = asking.ask_tell._told
    np.testing.assert_array_equal(
        told.states[:, 4:], np.tile(told.states[0, 4:], (still.task.horizon + 1, 1))
    )


@pytest.mark.slow
def test_what_cannot_be_is_one_line() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"failure": {"far": {"value": "position - place", "above": 1.0}}}, "failure.far: .* cannot depend"),
        ({"goal": None}, "targets: a goal, or outputs of a goal, must depend on them"),
        ({"targets": {**TARGETS, "angle": {"unit": "rad"}}}, "targets.angle: a state already has this name"),
        ({"targets": {"place": {"unit": "m", "uniform": [1, 0]}}}, "place: uniform is"),
    ]
    for changes, message in cases:
        with one_line(message):
            declared(**changes)
    with one_line("policy: follows one plan"):
        simbias.load(["preset=reacher", "policy=trajectory", "~policy.bound", "tracking=none"])


@pytest.mark.slow
def test_a_reachers_joints_are_asked_to_where_its_target_is() -> None:
    """By its outputs, inverse kinematics of the target; the drawing has both."""
    task: Any = simbias.load(["preset=reacher", "tracking=none"]).task
    for rng in np.random.default_rng(0).spawn(5):
        x = task.draw_start(rng)
        outputs = dict(zip((output.name for output in task.outputs), task.output(x), strict=True))
        there = x.copy()
        there[:2] -= outputs["off_shoulder"], outputs["off_elbow"]
        np.testing.assert_allclose(task.error(there, 0.0), 0.0, atol=1e-12)
        points = task.points(there)
        np.testing.assert_allclose(points["target"], points["load"], atol=1e-12)


def test_goals_beyond_the_rail_are_told_or_refused() -> None:
    """Half of the places, or all of them."""
    words = r"goal.position is .* where the task fails: leaves for %s of 100 drawn targets"

    def places(*ends: float) -> Declared:
        return declared(targets=TARGETS | {"place": {"unit": "m", "uniform": ends}})

    with pytest.warns(StudyWarning, match=words % r"[3-7]\d"):
        places(0.1, 1.8)
    with one_line(words % "100"):
        places(2.0, 3.0)
    with warnings.catch_warnings(action="error"):
        places(0.1, 0.9)
