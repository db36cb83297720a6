"""The engines against the laws that they should obey and each other, experiments against their contract."""

from typing import Any

import numpy as np
import pytest
from bongoboard_twin import (
    MOVING,
    START,
    UNLIMITED,
    Constant,
    build_task,
    build_twin,
    experiment,
    runge_kutta,
)

import simbias
from simbias.core import HardwareError
from simbias.core.records import Array
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.bongoboard.bodies import Assembly, contact
from simbias.robots.bongoboard.box2d import UNIT, Box2dBongoboard
from simbias.robots.bongoboard.model import LagrangianBongoboard
from simbias.robots.bongoboard.mujoco import MujocoBongoboard
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.simulation.control_loop import BLOW_UP
from simbias.simulation.noise import Noise

FEET = ("plate", "separate", "fixed")
# Found by CMA-ES on this hardware with a plate (300 evaluations of the summed cost of four starts, no noise).
BALANCING = np.array([9.92, 6.37, -8.36, -4.38, 5.77])
NOISE = {"torque_variance": 0.1, "angle_variance": 1e-6, "velocity_variance": 1e-3}


# Laws of mechanics


def test_trajectory_converges_to_the_lagrangian_models_with_order_one() -> None:
    """With an overlap in proportion to the time step, as it changes the geometry."""
    model, duration = LagrangianBongoboard(build_task(), foot_mass=1.0), 0.15
    for feet, torque in (("fixed", 0.0), ("plate", 5.0)):
        u = np.array([torque])
        reference = runge_kutta(lambda t, x, u=u: model.accelerations(x, u), START, duration, 400)[-1]
        errors = []
        for frames in (150, 300):
            task = build_twin(duration / frames, horizon=frames)
            hardware = PymunkBongoboard(task, feet=feet, overlap=0.1 * task.time_step)
            errors.append(np.linalg.norm(experiment(hardware, torque).states[-1] - reference))
        assert errors[0] < 5e-3
        assert np.log2(errors[0] / errors[1]) == pytest.approx(1, abs=0.05)


# Bodies


def test_masses_are_the_robots_and_an_inertia_error_scales_them() -> None:
    robot = build_task().robot
    masses = (robot.wheel_mass, robot.board_mass, robot.foot_mass, 2 * robot.leg_mass, robot.pelvis_mass)
    for feet in FEET:
        exact = PymunkBongoboard(build_task(), feet=feet).build(START).bodies
        scaled = PymunkBongoboard(build_task(), inertia_error=0.2, feet=feet).build(START).bodies
        for name, body in exact.items():
            assert (scaled[name].mass, scaled[name].moment) == pytest.approx(
                (1.2 * body.mass, 1.2 * body.moment)
            )
        inertias = Assembly(build_task(), feet=feet).inertias()
        assert sum(mass for mass, _ in inertias.values()) == pytest.approx(sum(masses))


def test_bodies_start_in_the_tasks_pose_and_motion() -> None:
    """Their velocities are the derivative of their places; contacts overlap by half of what they may."""
    task, overlap, h = build_task(), 1e-4, 1e-6
    for feet, x in zip((*FEET, "plate"), (MOVING, MOVING, MOVING, START), strict=True):
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


def test_rolling_and_joints_hold() -> None:
    """Bodies stay where the task's geometry has them, but for a small drift, while the robot balances."""
    task = build_task()
    for feet in ("fixed", "plate"):
        world = PymunkBongoboard(task, feet=feet).build(START)
        controller = OutputFeedback(task).controller(BALANCING, task.time_step)
        for _ in range(200):
            world.step(float(controller(np.array(world.state()))[0]))
        expected = Assembly(task, feet=feet).places(np.array(world.state()[:3]))
        for name, body in world.bodies.items():
            np.testing.assert_allclose((*body.position, body.angle), expected[name], rtol=0, atol=5e-4)


def test_a_single_foot_tips_where_a_plate_stands() -> None:
    """About its edge, where half of the torque exceeds its load times 0.1 m: at rest 25.5 N m."""
    for torque, tips in ((10.0, False), (60.0, True)):
        angles = {}
        for feet in ("plate", "separate"):
            world = PymunkBongoboard(build_task(), feet=feet).build(np.zeros(6))
            for _ in range(30):
                world.step(torque)
            tilts = [
                b.angle - world.bodies["board"].angle for name, b in world.bodies.items() if "foot" in name
            ]
            angles[feet] = np.abs(tilts).max()
        assert angles["plate"] < 1e-4
        assert (angles["separate"] > 1e-3) == tips


# Experiments


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
    short = ["tracking=none", "task.horizon=50", "hardware.noise.velocity_variance=1e-2"]
    study = simbias.load([*short, "hardware.record=measured"])
    costly = study.experiment(BALANCING, np.random.default_rng(0))  # its cost is of what was measured
    assert costly.cost == study.cost.of(costly)
    assert costly.cost > simbias.load(short).experiment(BALANCING, np.random.default_rng(0)).cost


# Failure


def test_failure_is_named_at_its_first_frame() -> None:
    cases: tuple[tuple[str, dict[str, float], Any, float], ...] = (
        ("board_touches_ground", {}, "plate", 5.0),
        ("board_leaves_wheel", {}, "fixed", 60.0),
        ("distance", {"distance": 0.3}, "plate", 0.0),
        ("body_angle", {"body_angle": 0.2}, "plate", 0.0),
        ("board_angle", {"board_angle": 0.2}, "plate", 20.0),
        ("speed", {"speed": 3.0}, "plate", 0.0),
    )
    for index, (criterion, limits, feet, torque) in enumerate(cases):
        task = build_task(UNLIMITED | limits)
        rollout = experiment(PymunkBongoboard(task, feet=feet), torque)
        assert rollout.failure == criterion == task.criteria[index].name
        assert rollout.failed_at is not None
        assert 0 < rollout.failed_at < task.horizon
        if index > 1:
            within = [task.measure(x)[index] <= task.criteria[index].limit for x in rollout.states]
            assert within == [True] * rollout.frames + [False]


def test_board_leaves_the_wheel_when_it_is_detached_far_enough() -> None:
    """Shorter gaps, of a few um, occur while the robot balances."""
    task = build_task(UNLIMITED)
    near, far = (
        experiment(PymunkBongoboard(task, feet="fixed", detachment=detachment), 60.0)
        for detachment in (1e-6, 3e-3)
    )
    assert near.failure == far.failure == "board_leaves_wheel"
    assert near.frames < far.frames


def test_torque_that_is_not_a_number_is_an_error_that_names_the_frame() -> None:
    class Breaking(Constant):
        def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
            return (np.array([np.nan]) if x[2] > 1e-4 else theta), memory

    with pytest.raises(HardwareError, match=r"in frame 6 the policy asks for an input of \[nan\]"):
        PymunkBongoboard(build_task()).run(Breaking(), np.zeros(1), START, np.random.default_rng(0))


ENGINES: tuple[Any, ...] = (Box2dBongoboard, MujocoBongoboard)


def test_a_frame_is_the_lagrangian_step() -> None:
    """For 0.1 s, as single precision and soft contacts allow; later, all is fast and contacts jump."""
    model = LagrangianBongoboard(build_task(), foot_mass=1.0)
    for engine, median in ((Box2dBongoboard, 1e-5), (MujocoBongoboard, 2e-4)):
        world = engine(build_task()).build(MOVING)
        np.testing.assert_allclose(world.state(), MOVING, atol=1e-6)
        states = experiment(engine(build_twin(horizon=100)), 5.0).states  # type: ignore[arg-type]
        errors = np.abs(states[1:] - model.step(states[:-1], np.array([5.0])))
        assert np.median(errors.max(axis=1)) < median
        assert errors.max() < 0.02


def test_energy_is_kept() -> None:
    """Falling turns 0.42 J into motion."""
    for engine in ENGINES:
        task = build_task(UNLIMITED)
        world, energies = engine(task).build(START), []
        for _ in range(150):
            world.step(0.0)
            energies.append(_energy(world, task.robot.gravity))
        assert np.ptp(energies) < 0.02 * 0.42


def test_a_heavier_robot_with_a_stronger_torque_moves_alike() -> None:
    task = build_task(horizon=100)
    for engine in (PymunkBongoboard, *ENGINES):
        one, other = (experiment(engine(task, error), (1 + error) * 5.0).states for error in (0.0, 0.2))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 if engine is PymunkBongoboard else 2e-3)
        assert np.abs(experiment(engine(task, 0.2), 5.0).states - one).max() > 0.01


@pytest.mark.slow
def test_failures_are_the_tasks() -> None:
    task = build_task(UNLIMITED)
    for engine in (PymunkBongoboard, *ENGINES):
        assert experiment(engine(task), 5.0).failure == "board_touches_ground"
        assert experiment(engine(build_task()), 0.0).failure == "body_angle"
        blown_up = experiment(engine(task), 1e8)
        assert (blown_up.failure, blown_up.failed_at) == (BLOW_UP, 0)
        np.testing.assert_array_equal(blown_up.states, [START])
        rollout = experiment(engine(build_task()), 0.0, np.array([0.0, 0.05, 1.2, 0.0, 0.0, 0.0]))
        assert (rollout.failure, rollout.failed_at) == ("body_angle", 0)
        with pytest.raises(HardwareError, match="cannot start"):
            experiment(engine(build_task()), 0.0, np.full(6, np.nan))


def test_an_experiment_is_determined_by_its_seed() -> None:
    for engine in ENGINES:
        hardware = engine(build_task(horizon=30), noise={"torque_variance": 0.1})
        one, other, third = (experiment(hardware, 0.0, seed=seed).states for seed in (0, 0, 1))
        np.testing.assert_array_equal(one, other)
        assert not np.array_equal(one, third)


@pytest.mark.slow
def test_a_policy_that_balances_one_engine_balances_the_others() -> None:
    task = build_task(horizon=1000)  # without torque, it falls within 0.7 s
    for engine in (PymunkBongoboard, *ENGINES):
        made = engine(task).run(OutputFeedback(task), BALANCING, START, np.random.default_rng(0))
        assert made.failure is None


def _energy(world: Any, gravity: float) -> float:
    """Kinetic and potential energy in J of all bodies."""
    if hasattr(world, "bodies"):
        return sum(
            0.5 * body.mass * (body.linearVelocity[0] ** 2 + body.linearVelocity[1] ** 2) * UNIT**2
            + 0.5 * (body.massData.I * UNIT**2) * body.angularVelocity**2
            + body.mass * gravity * body.position.y * UNIT
            for body in world.bodies.values()
        )
    from simbias.robots.mujoco.parameters import mujoco

    mujoco().mj_energyPos(world._model, world.data)
    mujoco().mj_energyVel(world._model, world.data)
    return float(world.data.energy.sum())
