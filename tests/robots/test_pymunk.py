"""The engine against the laws that it should obey, and experiments against their contract."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bongoboard_twin import (
    CONF,
    MOVING,
    START,
    UNLIMITED,
    Constant,
    assert_consistent,
    build_task,
    build_twin,
    energy,
    experiment,
    runge_kutta,
)
from omegaconf import OmegaConf
from pydantic import TypeAdapter

import simbias
from simbias.core import HardwareError
from simbias.core.records import Array
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.bongoboard.bodies import Assembly, contact
from simbias.robots.bongoboard.gaps import Gaps
from simbias.robots.bongoboard.model import LagrangianBongoboard
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.simulation.control_loop import BLOW_UP
from simbias.simulation.noise import Noise

FEET = ("plate", "separate", "fixed")
# Found by CMA-ES on this hardware with a plate (300 evaluations of the summed cost of four starts, no noise).
BALANCING = np.array([9.92, 6.37, -8.36, -4.38, 5.77])
# Found by DIRECT on the nominal model, as Algorithm 1 begins.
NOMINALLY_BEST = np.array([8.1177, 4.7310, -6.7398, -1.0242, -5.5601])
NOISE = {"torque_variance": 0.1, "angle_variance": 1e-6, "velocity_variance": 1e-3}


def exact(model: LagrangianBongoboard, u: Array, duration: float) -> Array:
    """State (6,) of the model after a duration from START."""
    return runge_kutta(lambda t, x: model.accelerations(x, u), START, duration, 400)[-1]


# Laws of mechanics


@pytest.mark.parametrize("feet", ["fixed", "plate"])
@pytest.mark.parametrize(
    ("x", "torque", "expected"),
    [
        (START, 0.0, (-2.27865663, -1.18581346, 7.66572464)),
        (MOVING, 10.0, (-26.96107964, 8.44049104, 53.78564873)),
    ],
)
def test_accelerations_are_the_lagrangian_models(
    feet: Any, x: Array, torque: float, expected: tuple[float, ...]
) -> None:
    """The reference of LagrangianBongoboard at foot mass 1, also for a plate, as long as it rests flat.

    In a frame of 0.1 ms they change by up to 0.01 rad/s^2.
    """
    hardware = PymunkBongoboard(build_twin(1e-4, horizon=1), feet=feet, iterations=1000, overlap=1e-6)
    states = experiment(hardware, torque, x).states
    np.testing.assert_allclose((states[1] - states[0])[3:] / 1e-4, expected, rtol=0, atol=0.02)


@pytest.mark.parametrize("feet", ["fixed", "plate"])
def test_contact_forces_are_found_before_the_first_frame(feet: Any) -> None:
    hardware = PymunkBongoboard(build_twin(horizon=10), feet=feet)
    accelerations = np.diff(experiment(hardware, 0.0).states[:, 3:], axis=0) / 1e-3
    np.testing.assert_allclose(accelerations[0], (-2.27865663, -1.18581346, 7.66572464), rtol=0, atol=0.01)
    assert np.abs(np.diff(accelerations, axis=0)).max() < 0.01


@pytest.mark.parametrize("torque", [-3.0, 0.0, 5.0])
@pytest.mark.parametrize("feet", ["fixed", "plate"])
def test_each_frame_agrees_with_the_lagrangian_step(feet: Any, torque: float) -> None:
    """The engine moves before it accelerates, the model's step the other way round.

    So the model has to step from the angles of a frame and the rates of the frame before to those a frame
    later. The tolerance is for what the solver leaves after its iterations.
    """
    u = np.array([torque])
    states = experiment(PymunkBongoboard(build_twin(horizon=150), feet=feet), torque).states
    staggered = np.column_stack((states[1:, :3], states[:-1, 3:]))
    model = LagrangianBongoboard(build_task(), foot_mass=1.0)
    predicted = np.array([model.step(x, u) for x in staggered[:-1]])
    np.testing.assert_allclose(staggered[1:], predicted, rtol=0, atol=5e-4)


@pytest.mark.parametrize("torque", [-3.0, 0.0, 5.0])
@pytest.mark.parametrize("feet", ["fixed", "plate"])
def test_trajectory_converges_to_the_lagrangian_models_with_order_one(feet: Any, torque: float) -> None:
    """With an overlap in proportion to the time step, as it changes the geometry."""
    duration = 0.15
    reference = exact(LagrangianBongoboard(build_task(), foot_mass=1.0), np.array([torque]), duration)
    errors = []
    for frames in (150, 300, 600):
        task = build_twin(duration / frames, horizon=frames)
        hardware = PymunkBongoboard(task, feet=feet, overlap=0.1 * task.time_step)
        errors.append(np.linalg.norm(experiment(hardware, torque).states[-1] - reference))
    assert errors[0] < 5e-3
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1, atol=0.05)


def test_energy_error_shrinks_with_the_time_step() -> None:
    """Falling turns 0.42 J into motion; the steps' order is one."""
    errors = []
    for frames in (150, 300):
        task = build_task(time_step=0.15 / frames)
        world = PymunkBongoboard(task, feet="fixed").build(START)
        energies = [energy(world, task.robot.gravity)]
        for _ in range(frames):
            world.step(0.0)
            energies.append(energy(world, task.robot.gravity))
        errors.append(np.ptp(energies))
    assert errors[0] < 0.02 * 0.42
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("feet", FEET)
def test_positive_torque_turns_the_legs_counter_clockwise_against_the_board(feet: Any) -> None:
    hardware = PymunkBongoboard(build_task(horizon=20), feet=feet)
    free, pushed = experiment(hardware, 0.0).states[-1], experiment(hardware, 5.0).states[-1]
    leg_rate, board_rate = np.array([0, 0, 0, 1, 1, 1]), np.array([0, 0, 0, 1, 1, 0])
    assert (pushed - free)[5] > 0
    assert leg_rate @ (pushed - free) > 0 > board_rate @ (pushed - free)


# Bodies


@pytest.mark.parametrize("feet", FEET)
def test_inertia_error_scales_every_mass_and_moment(feet: Any) -> None:
    exact = PymunkBongoboard(build_task(), feet=feet).build(START).bodies
    scaled = PymunkBongoboard(build_task(), inertia_error=0.2, feet=feet).build(START).bodies
    assert exact.keys() == scaled.keys()
    for name, body in exact.items():
        assert (scaled[name].mass, scaled[name].moment) == pytest.approx((1.2 * body.mass, 1.2 * body.moment))


@pytest.mark.parametrize("feet", FEET)
def test_masses_are_the_robots(feet: Any) -> None:
    assembly = Assembly(build_task(), feet=feet)
    robot = assembly.task.robot
    masses = (robot.wheel_mass, robot.board_mass, robot.foot_mass, 2 * robot.leg_mass, robot.pelvis_mass)
    assert sum(mass for mass, _ in assembly.inertias().values()) == pytest.approx(sum(masses))


def test_separate_feet_are_the_plate_cut_in_two() -> None:
    bodies = PymunkBongoboard(build_task(), feet="separate").build(START).bodies
    assert bodies["left foot"].mass == bodies["right foot"].mass == pytest.approx(0.5)
    assert bodies["left foot"].moment == pytest.approx(0.5 * (0.2**2 + 0.05**2) / 12)
    for name in ("foot", "leg"):
        apart = bodies[f"right {name}"].position - bodies[f"left {name}"].position
        assert apart.length == pytest.approx(0.2)


@pytest.mark.parametrize("x", [START, MOVING])
@pytest.mark.parametrize("feet", FEET)
def test_bodies_start_in_the_tasks_pose_and_motion(feet: Any, x: Array) -> None:
    """Their velocities are the derivative of their places; contacts overlap by half of what they may."""
    task, overlap, h = build_task(), 1e-4, 1e-6
    world = PymunkBongoboard(task, feet=feet, overlap=overlap).build(x)
    pose = task.pose(x[:3])
    expected = {
        "wheel": (*pose.wheel, pose.wheel_angle),
        "board": (*pose.board, pose.board_angle),
        "pelvis": (*pose.pelvis, pose.board_angle),
    }
    ahead, behind = (Assembly(task, feet=feet).places(x[:3] + step * x[3:]) for step in (h, -h))
    for name, body in world.bodies.items():
        place, velocity = (*body.position, body.angle), (*body.velocity, body.angular_velocity)
        np.testing.assert_allclose(velocity, (ahead[name] - behind[name]) / (2 * h), rtol=0, atol=1e-8)
        if name in expected:
            np.testing.assert_allclose(place, expected[name], rtol=0, atol=1.5 * overlap)
    legs = (world.bodies["left leg"].position + world.bodies["right leg"].position) / 2
    np.testing.assert_allclose(legs, (pose.ankles + pose.pelvis) / 2, rtol=0, atol=1.5 * overlap)
    np.testing.assert_allclose(world.state(), x, rtol=0, atol=1e-12)
    assert contact(task.robot, *world.wheel_and_board()) == pytest.approx(
        (task.measure(x)[0], -overlap / 2), abs=1.5 * overlap
    )


@pytest.mark.parametrize("feet", ["fixed", "plate"])
def test_rolling_and_joints_hold(feet: Any) -> None:
    """Bodies stay where the task's geometry has them, but for a small drift, while the robot balances."""
    task = build_task()
    world = PymunkBongoboard(task, feet=feet).build(START)
    controller = OutputFeedback(task).controller(BALANCING, task.time_step)
    for _ in range(300):
        x = np.array(world.state())
        world.step(float(controller(x)[0]))
    expected = Assembly(task, feet=feet).places(np.array(world.state()[:3]))
    for name, body in world.bodies.items():
        np.testing.assert_allclose((*body.position, body.angle), expected[name], rtol=0, atol=5e-4)


@pytest.mark.parametrize(("torque", "tips"), [(10.0, False), (60.0, True)])
def test_a_single_foot_tips_where_a_plate_stands(torque: float, tips: bool) -> None:
    """About its edge, where half of the torque exceeds its load times 0.1 m: at rest 25.5 N m."""
    robot = build_task().robot
    weight = (robot.pelvis_mass + 2 * robot.leg_mass + robot.foot_mass) * robot.gravity
    at_rest = weight * robot.foot_length / 4
    assert (torque > at_rest) == tips
    angles = {}
    for feet in ("plate", "separate"):
        world = PymunkBongoboard(build_task(), feet=feet).build(np.zeros(6))
        for _ in range(30):
            world.step(torque)
        bodies = world.bodies
        tilts = [body.angle - bodies["board"].angle for name, body in bodies.items() if "foot" in name]
        angles[feet] = np.abs(tilts).max()
    assert angles["plate"] < 1e-4
    assert (angles["separate"] > 1e-3) == tips


def test_the_nominal_models_policy_falls_from_separate_feet() -> None:
    task = build_task()
    hardware = PymunkBongoboard(task, feet="separate")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rollout = hardware.run(OutputFeedback(task), NOMINALLY_BEST, task.draw_start(rng), rng)
        assert_consistent(rollout)
        assert rollout.failed_at is not None


# Experiments


@pytest.mark.slow
@pytest.mark.parametrize("inertia_error", [0.0, 0.2])
def test_robot_on_a_plate_can_balance(inertia_error: float) -> None:
    task = build_task()
    hardware, rng = PymunkBongoboard(task, inertia_error), np.random.default_rng(0)
    for start in (START, task.draw_start(rng), task.draw_start(rng)):
        rollout = hardware.run(OutputFeedback(task), BALANCING, start, rng)
        assert_consistent(rollout)
        assert rollout.failed_at is None
        assert rollout.frames == task.horizon


class Replay(Constant):
    """Inputs (k, 1), frame by frame."""

    def __init__(self, inputs: Array) -> None:
        self._inputs = inputs

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        return self._inputs[round(t / 0.001)], memory


def test_noise_is_in_what_is_seen_and_in_what_acts() -> None:
    """As it is drawn from the generator. The policy sees it; the record has the inputs as commanded."""
    task = build_task(horizon=100)
    hardware, policy = PymunkBongoboard(task, noise=NOISE), OutputFeedback(task)
    one, same, other = (
        hardware.run(policy, BALANCING, START, np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert one.measured is not None
    for name in ("states", "inputs", "measured"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
        assert not np.array_equal(getattr(one, name), getattr(other, name))
    drawn = Noise(task, NOISE).draw(np.random.default_rng(1))
    np.testing.assert_array_equal(one.measured, one.states + drawn.sensors)
    controller = policy.controller(BALANCING, task.time_step)
    np.testing.assert_array_equal(one.inputs, [controller(y) for y in one.measured[:-1]])
    quiet = PymunkBongoboard(task).run(
        Replay(one.inputs + drawn.inputs), np.zeros(1), START, np.random.default_rng(0)
    )
    np.testing.assert_array_equal(quiet.states, one.states)
    np.testing.assert_array_equal(quiet.measured, quiet.states)


def test_a_record_of_what_is_measured_is_of_the_same_experiment() -> None:
    """A real robot's view: nothing changes but what is recorded."""
    noise, limits = NOISE, UNLIMITED | {"body_angle": 0.2}
    true, real = (
        experiment(PymunkBongoboard(build_task(limits), noise=noise, record=record), 0.0)
        for record in ("true_state", "measured")
    )
    assert not true.sensed
    assert real.sensed
    assert not np.array_equal(real.states, true.states)
    assert real.measured is not None
    np.testing.assert_array_equal(real.states, true.measured)
    np.testing.assert_array_equal(real.states, real.measured)
    np.testing.assert_array_equal(real.inputs, true.inputs)
    assert real.failure is not None
    assert (real.failed_at, real.failure) == (true.failed_at, true.failure)


def test_failure_is_judged_by_the_true_states() -> None:
    """A sensor that errs by 0.3 rad sees the body beyond its limit long before it is."""
    noise = {"angle_variance": 0.09}
    hardware = PymunkBongoboard(build_task(UNLIMITED | {"body_angle": 0.2}), noise=noise, record="measured")
    rollout = experiment(hardware, 0.0)
    leaning = np.abs(rollout.states[:, :3].sum(axis=1)) > 0.2
    assert rollout.failed_at is not None
    assert leaning[: rollout.failed_at].any()


def test_a_measured_record_costs_what_was_measured() -> None:
    noise = {f"hardware.noise.{key}_variance": 1e-2 for key in ("angle", "velocity")}
    overrides = ["tracking=none", "task.horizon=50", *(f"{key}={value}" for key, value in noise.items())]
    true, real = (
        simbias.load([*overrides, f"hardware.record={record}"]).experiment(
            BALANCING, np.random.default_rng(0)
        )
        for record in ("true_state", "measured")
    )
    study = simbias.load(overrides)
    assert real.cost == study.cost.of(replace(true, states=true.measured))
    assert real.cost > true.cost


# Failure


@pytest.mark.parametrize(
    ("criterion", "limits", "feet", "torque"),
    [
        ("board_touches_ground", {}, "plate", 5.0),
        ("board_leaves_wheel", {}, "fixed", 60.0),
        ("distance", {"distance": 0.3}, "plate", 0.0),
        ("body_angle", {"body_angle": 0.2}, "plate", 0.0),
        ("board_angle", {"board_angle": 0.2}, "plate", 20.0),
        ("speed", {"speed": 3.0}, "plate", 0.0),
    ],
)
def test_failure_is_named_at_its_first_frame(
    criterion: str, limits: dict[str, float], feet: Any, torque: float
) -> None:
    task = build_task(UNLIMITED | limits)
    hardware = PymunkBongoboard(task, feet=feet)
    rollout = experiment(hardware, torque)
    index = [c.name for c in task.criteria].index(criterion)
    assert rollout.failure == task.criteria[index].name
    assert rollout.failed_at is not None
    assert 0 < rollout.failed_at < task.horizon
    if index > 1:
        within = [task.measure(x)[index] <= task.criteria[index].limit for x in rollout.states]
        assert within == [True] * rollout.frames + [False]


def test_board_leaves_the_wheel_when_it_is_detached_far_enough() -> None:
    """Shorter gaps, of a few um, occur while the robot balances."""
    task = build_task(UNLIMITED)
    rollouts = [
        experiment(PymunkBongoboard(task, feet="fixed", detachment=detachment), 60.0)
        for detachment in (1e-6, 1e-3, 3e-3)
    ]
    assert {rollout.failure for rollout in rollouts} == {"board_leaves_wheel"}
    first, second, third = (rollout.frames for rollout in rollouts)
    assert first < second < third


@pytest.mark.parametrize(
    ("start", "failure"),
    [
        (np.array([0.0, 0.05, 0.0, 40.0, 0.0, 0.0]), "speed"),
        (np.array([0.0, 0.05, 1.2, 0.0, 0.0, 0.0]), "body_angle"),
        (np.array([0.6, 0.35, -1.0, 0.0, 0.0, 0.0]), "board_touches_ground"),
        (np.array([0.0, 0.0, 1e300, 0.0, 0.0, 0.0]), "distance"),
    ],
)
def test_start_can_be_a_failure(start: Array, failure: str) -> None:
    rollout = experiment(PymunkBongoboard(build_task()), 0.0, start)
    assert rollout.failure == failure
    assert rollout.failed_at == 0
    np.testing.assert_array_equal(rollout.states, [start])


@pytest.mark.parametrize("torque", [1e6, -1e20, 1e308])
@pytest.mark.parametrize("feet", FEET)
def test_blow_up_is_a_failure_and_leaves_no_trace_in_the_data(feet: Any, torque: float) -> None:
    rollout = experiment(PymunkBongoboard(build_task(UNLIMITED), feet=feet), torque)
    assert rollout.failure == BLOW_UP
    assert rollout.failed_at == 0
    np.testing.assert_array_equal(rollout.states, [START])


@pytest.mark.parametrize("torque", [np.nan, np.inf])
def test_torque_that_is_not_a_number_is_an_error_that_names_the_frame(torque: float) -> None:
    class Breaking(Constant):
        def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
            return (np.array([torque]) if x[2] > 1e-4 else theta), memory

    with pytest.raises(HardwareError, match=r"in frame 6 the policy asks for an input of \[(nan|inf)\]"):
        PymunkBongoboard(build_task()).run(Breaking(), np.zeros(1), START, np.random.default_rng(0))


# Configuration


def test_defaults_are_the_configs() -> None:
    config = OmegaConf.to_container(OmegaConf.load(CONF / "hardware" / "pymunk.yaml"))
    assert isinstance(config, dict)
    parameters = inspect.signature(PymunkBongoboard).parameters
    defaults = {name: parameters[name].default for name in parameters if name != "task"}
    del config["_target_"]
    assert TypeAdapter(Gaps).validate_python(config["gaps"]) == Gaps()
    assert not any(config["noise"].values())
    assert defaults == config | {"noise": {}, "gaps": Gaps()}
