"""The bongoboard's equations of motion: reference values, laws of mechanics, and a second derivation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from simbias.nominal import derive_bongoboard
from simbias.nominal.bongoboard import LagrangianBongoboard
from simbias.task.bongoboard import Bongoboard, Limits, Robot, Start

CONFIG = Path(__file__).parents[2] / "conf" / "task" / "bongoboard.yaml"
NO_TORQUE = np.zeros(1)
START = np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])
MOVING = np.array([0.1, -0.05, 0.08, 0.3, -0.2, 0.5])

angles = st.tuples(*[st.floats(-0.6, 0.6)] * 3)
rates = st.tuples(*[st.floats(-5, 5)] * 3)
states = st.builds(lambda angles, rates: np.array(angles + rates), angles, rates)
torques = st.floats(-100, 100).map(lambda torque: np.array([torque]))
foot_masses = st.floats(0, 5)
MASSES = ("wheel_mass", "board_mass", "leg_mass", "pelvis_mass", "pelvis_inertia")
LENGTHS = ("wheel_radius", "board_length", "board_thickness", "ankle_height", "foot_length", "leg_length")


def build_task(time_step=0.001, **factors):
    """The task of conf/task/bongoboard.yaml, fields of its robot times factors."""
    config = OmegaConf.to_container(OmegaConf.load(CONFIG))
    robot = Robot(**config["robot"])
    robot = replace(robot, **{name: getattr(robot, name) * factor for name, factor in factors.items()})
    return Bongoboard(robot, Limits(**config["limits"]), Start(**config["start"]), time_step=time_step)


TASK = build_task()
MODEL = LagrangianBongoboard(TASK)
models = foot_masses.map(lambda foot_mass: LagrangianBongoboard(TASK, foot_mass))
factors = st.fixed_dictionaries(dict.fromkeys(MASSES + LENGTHS, st.floats(0.5, 2)))
tasks = factors.map(lambda factors: build_task(**factors))


def runge_kutta(model, x, u, time_step, frames):
    """States (frames + 1, 6) of the fourth-order method."""

    def slope(x):
        return np.concatenate((x[3:], model.accelerations(x, u)))

    states = [x]
    for _ in range(frames):
        k1 = slope(x)
        k2 = slope(x + time_step / 2 * k1)
        k3 = slope(x + time_step / 2 * k2)
        k4 = slope(x + time_step * k3)
        x = x + time_step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    return np.array(states)


# Reference values of an earlier, independent derivation with the parameters of conf/task/bongoboard.yaml. It
# kept its energy to 1e-10 and agreed with a rigid-body engine whose feet were fixed to the board.


@pytest.mark.parametrize(
    ("foot_mass", "x", "torque", "expected"),
    [
        (0.0, START, 0.0, (-3.0360413, -0.43211239, 8.34390762)),
        (0.0, MOVING, 10.0, (-32.96393919, 13.44444722, 60.30524633)),
        (1.0, START, 0.0, (-2.27865663, -1.18581346, 7.66572464)),
        (1.0, MOVING, 10.0, (-26.96107964, 8.44049104, 53.78564873)),
    ],
)
def test_accelerations_are_the_reference(foot_mass, x, torque, expected):
    model = LagrangianBongoboard(TASK, foot_mass)
    np.testing.assert_allclose(model.accelerations(x, np.array([torque])), expected, rtol=0, atol=1e-6)


def test_outputs_are_the_reference():
    expected = (-0.07885799, -0.30512553, 0.08, 0.5, 0.05)
    np.testing.assert_allclose(TASK.output(MOVING), expected, rtol=0, atol=1e-8)


def test_linearisation_has_the_reference_eigenvalues():
    h = 1e-5
    columns = [
        (MODEL.accelerations(dx, NO_TORQUE) - MODEL.accelerations(-dx, NO_TORQUE)) / (2 * h)
        for dx in h * np.eye(6)
    ]
    linear = np.vstack((np.eye(6)[3:], np.transpose(columns)))
    expected = [-14.4436, -3.1324, -10.1247j, 10.1247j, 3.1324, 14.4436]
    eigenvalues = np.sort_complex(np.round(np.linalg.eigvals(linear), 4))  # rounded, so that a pair sorts
    np.testing.assert_allclose(eigenvalues, expected, rtol=0, atol=1.5e-4)


# Laws of mechanics


@pytest.mark.parametrize("foot_mass", [0.0, 1.0])
def test_energy_is_conserved_without_torque(foot_mass):
    model = LagrangianBongoboard(TASK, foot_mass)
    energies = [model.energy(x) for x in runge_kutta(model, START, NO_TORQUE, 0.001, 300)]
    assert np.ptp(energies) < 1e-10 * abs(energies[0])


@given(model=models, x=states, u=torques)
@settings(deadline=None)
def test_power_is_torque_times_ankle_rate(model, x, u):
    direction = np.concatenate((x[3:], model.accelerations(x, u)))
    h = 1e-3 / (1 + np.linalg.norm(direction))
    ahead, behind, far_ahead, far_behind = (model.energy(x + k * h * direction) for k in (1, -1, 2, -2))
    power = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * h)
    assert power == pytest.approx(u[0] * x[5], rel=1e-6, abs=1e-5)


@given(model=models, x=states, u=torques)
@settings(deadline=None)
def test_mirrored_robot_moves_mirrored(model, x, u):
    np.testing.assert_array_equal(model.accelerations(-x, -u), -model.accelerations(x, u))


@pytest.mark.slow
@given(x=states, u=torques, factor=st.floats(0.1, 10))
@settings(deadline=None)
def test_heavier_robot_with_stronger_torque_moves_alike(x, u, factor):
    heavier = LagrangianBongoboard(build_task(**dict.fromkeys(MASSES, factor)), foot_mass=factor)
    expected = LagrangianBongoboard(TASK, foot_mass=1.0).accelerations(x, u)
    tolerance = 1e-10 * (1 + np.linalg.norm(expected))
    np.testing.assert_allclose(heavier.accelerations(x, factor * u), expected, rtol=0, atol=tolerance)


# A second derivation: Newton and Euler for five free bodies, held together by forces of constraint. It shares
# nothing with the first but the positions of the task.

WHEEL, BOARD, FOOT, LEGS, PELVIS = range(5)


def placements(task, angles):
    """Positions and angles (5, 3) of the bodies' centres of mass."""
    pose, robot = task.pose(angles), task.robot
    normal = np.array([-np.sin(pose.board_angle), np.cos(pose.board_angle)])
    foot = pose.ankles - robot.ankle_height / 2 * normal
    return np.array(
        [
            [*pose.wheel, pose.wheel_angle],
            [*pose.board, pose.board_angle],
            [*foot, pose.board_angle],
            [*((pose.ankles + pose.pelvis) / 2), pose.leg_angle],
            [*pose.pelvis, pose.board_angle],
        ]
    )


def gaps(robot, place, velocity):
    """Velocities (12,) between material points that stay together: zero, and linear in velocity (5, 3)."""

    def at(body, offset):
        return velocity[body, :2] + velocity[body, 2] * np.array([-offset[1], offset[0]])

    phi, psi = place[BOARD, 2], place[LEGS, 2]
    normal = np.array([-np.sin(phi), np.cos(phi)])
    half_leg = robot.leg_length / 2 * np.array([-np.sin(psi), np.cos(psi)])
    contact = place[WHEEL, :2] + robot.wheel_radius * normal
    glued = place[FOOT, :2] - place[BOARD, :2]
    ankle = (robot.board_thickness / 2 + robot.ankle_height) * normal
    return np.concatenate(
        [
            at(WHEEL, (0.0, -robot.wheel_radius)),  # on the floor, at rest
            at(BOARD, contact - place[BOARD, :2]) - at(WHEEL, contact - place[WHEEL, :2]),
            at(FOOT, (0.0, 0.0)) - at(BOARD, glued),
            at(LEGS, -half_leg) - at(BOARD, ankle),
            at(PELVIS, (0.0, 0.0)) - at(LEGS, half_leg),
            [velocity[FOOT, 2] - velocity[BOARD, 2], velocity[PELVIS, 2] - velocity[BOARD, 2]],
        ]
    )


def newton_euler(task, foot_mass, x, torque):
    """Accelerations (3,) of alpha_w, alpha_b, theta, and gaps (12,) that the task's positions would open."""
    robot, tiny = task.robot, 1e-30j
    place = placements(task, x[:3])
    velocity = placements(task, x[:3] + tiny * x[3:]).imag / tiny.imag
    jacobian = np.array([gaps(robot, place, unit.reshape(5, 3)) for unit in np.eye(15)]).T
    drift = gaps(robot, place + tiny * velocity, velocity).imag / tiny.imag

    masses = np.array([robot.wheel_mass, robot.board_mass, foot_mass, 2 * robot.leg_mass, robot.pelvis_mass])
    inertias = masses * [
        robot.wheel_radius**2 / 2,
        (robot.board_length**2 + robot.board_thickness**2) / 12,
        (robot.foot_length**2 + robot.ankle_height**2) / 12,
        robot.leg_length**2 / 12,
        robot.pelvis_inertia / robot.pelvis_mass,
    ]
    forces = np.zeros((5, 3))
    forces[:, 1] = -masses * robot.gravity
    forces[LEGS, 2], forces[FOOT, 2] = torque, -torque

    inertia = np.diag(np.column_stack((masses, masses, inertias)).ravel())
    system = np.block([[inertia, jacobian.T], [jacobian, np.zeros((12, 12))]])
    solution = np.linalg.solve(system, np.concatenate((forces.ravel(), -drift)))
    wheel, board, legs = solution[:15].reshape(5, 3)[[WHEEL, BOARD, LEGS], 2]
    return np.array([wheel, board - wheel, legs - board]), jacobian @ velocity.ravel()


@pytest.mark.slow
@given(task=tasks, foot_mass=foot_masses, x=states, u=torques)
@settings(deadline=None)
def test_accelerations_agree_with_newton_and_euler(task, foot_mass, x, u):
    expected, opening = newton_euler(task, foot_mass, x, u[0])
    np.testing.assert_allclose(opening, 0, atol=1e-12)
    actual = LagrangianBongoboard(task, foot_mass).accelerations(x, u)
    tolerance = 1e-10 * (1 + np.linalg.norm(expected))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


# The step


@given(x=states, u=torques)
@settings(deadline=None)
def test_step_is_semi_implicit_euler(x, u):
    before = x.copy()
    rates = x[3:] + TASK.time_step * newton_euler(TASK, 0.0, x, u[0])[0]
    expected = np.concatenate((x[:3] + TASK.time_step * rates, rates))
    np.testing.assert_allclose(MODEL.step(x, u), expected, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(x, before)


def test_step_converges_with_order_one():
    duration, u = 0.2, np.array([5.0])
    exact = runge_kutta(MODEL, MOVING, u, 0.0005, 400)[-1]
    errors = []
    for frames in (400, 800, 1600):
        model = LagrangianBongoboard(build_task(time_step=duration / frames))
        x = MOVING
        for _ in range(frames):
            x = model.step(x, u)
        errors.append(np.linalg.norm(x - exact))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 1, atol=0.05)


# The generated module


@pytest.mark.slow
def test_generated_equations_are_up_to_date():
    assert derive_bongoboard.generate() == derive_bongoboard.TARGET.read_text(encoding="utf-8")
