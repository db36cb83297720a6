"""The bongoboard: its equations against reference values, laws and a second derivation; its geometry."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bongoboard_twin import MOVING, START, build_task, runge_kutta
from hypothesis import given, settings
from hypothesis import strategies as st
from models import with_values

from simbias.core.records import Array
from simbias.robots.bongoboard.model import MECHANICAL, LagrangianBongoboard, Uncertainty
from simbias.trial.study import Study

NO_TORQUE = np.zeros(1)

angles = st.tuples(*[st.floats(-0.6, 0.6)] * 3)
rates = st.tuples(*[st.floats(-5, 5)] * 3)
states = st.builds(lambda angles, rates: np.array(angles + rates), angles, rates)
torques = st.floats(-100, 100).map(lambda torque: np.array([torque]))
foot_masses = st.floats(0, 5)
MASSES = ("wheel_mass", "board_mass", "leg_mass", "pelvis_mass", "pelvis_inertia")
LENGTHS = ("wheel_radius", "board_length", "board_thickness", "ankle_height", "foot_length", "leg_length")


TASK = build_task()


def scaled(**factors):
    """The task, fields of its robot times factors."""
    return build_task(robot={name: getattr(TASK.robot, name) * factor for name, factor in factors.items()})


MODEL = LagrangianBongoboard(TASK)
factors = st.fixed_dictionaries(dict.fromkeys(MASSES + LENGTHS, st.floats(0.5, 2)))
tasks = factors.map(lambda factors: scaled(**factors))


def fall(model, frames=300):
    """States (frames + 1, 6) without torque, in ms, by the fourth-order method."""
    return runge_kutta(lambda t, x: model.accelerations(x, NO_TORQUE), START, 1e-3 * frames, frames)


# Reference values of an earlier, independent derivation with the parameters of conf/task/bongoboard.yaml. It
# kept its energy to 1e-10 and agreed with a rigid-body engine whose feet were fixed to the board.


def test_accelerations_are_the_reference():
    for foot_mass, x, torque, expected in (
        (0.0, START, 0.0, (-3.0360413, -0.43211239, 8.34390762)),
        (0.0, MOVING, 10.0, (-32.96393919, 13.44444722, 60.30524633)),
        (1.0, START, 0.0, (-2.27865663, -1.18581346, 7.66572464)),
        (1.0, MOVING, 10.0, (-26.96107964, 8.44049104, 53.78564873)),
    ):
        actual = LagrangianBongoboard(TASK, foot_mass).accelerations(x, np.array([torque]))
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-6)


def test_outputs_are_the_reference():
    expected = (-0.07885799, -0.30512553, 0.08, 0.5, 0.05)
    np.testing.assert_allclose(TASK.output(MOVING), expected, rtol=0, atol=1e-8)


# Laws of mechanics


def test_energy_is_conserved_without_torque():
    for foot_mass in (0.0, 1.0):
        energies = [energy(foot_mass, x) for x in fall(LagrangianBongoboard(TASK, foot_mass))]
        assert np.ptp(energies) < 1e-10 * abs(energies[0])


# A second derivation: Newton and Euler for five free bodies, held together by forces of constraint. It shares
# nothing with the first but the positions of the task.

WHEEL, BOARD, FOOT, LEGS, PELVIS = range(5)


def placements(task, angles, pelvis_offset):
    """Positions and angles (5, 3) of the bodies' centres of mass; the pelvis' from its middle, as it lies."""
    pose, robot = task.pose(angles), task.robot
    normal = np.array([-np.sin(pose.board_angle), np.cos(pose.board_angle)])
    foot = pose.ankles - robot.ankle_height / 2 * normal
    pelvis = pose.pelvis + turned(pelvis_offset, pose.board_angle)
    return np.array(
        [
            [*pose.wheel, pose.wheel_angle],
            [*pose.board, pose.board_angle],
            [*foot, pose.board_angle],
            [*((pose.ankles + pose.pelvis) / 2), pose.leg_angle],
            [*pelvis, pose.board_angle],
        ]
    )


def turned(vector, angle):
    """A vector (2,) of a body that has turned by an angle."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ vector


def gaps(robot, place, velocity, pelvis_offset):
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
            at(PELVIS, -turned(pelvis_offset, phi)) - at(LEGS, half_leg),
            [velocity[FOOT, 2] - velocity[BOARD, 2], velocity[PELVIS, 2] - velocity[BOARD, 2]],
        ]
    )


def bodies(robot, foot_mass, payload=(0.0, 0.0, 0.0)):
    """Masses (5,), moments of inertia (5,), and where pelvis and payload have their common centre of mass."""
    load, *at_load = payload
    pelvis = robot.pelvis_mass + load
    off = load * np.array(at_load) / pelvis
    pelvis_inertia = (
        robot.pelvis_inertia + robot.pelvis_mass * off @ off + load * np.sum((at_load - off) ** 2)
    )
    masses = np.array([robot.wheel_mass, robot.board_mass, foot_mass, 2 * robot.leg_mass, pelvis])
    inertias = masses * [
        robot.wheel_radius**2 / 2,
        (robot.board_length**2 + robot.board_thickness**2) / 12,
        (robot.foot_length**2 + robot.ankle_height**2) / 12,
        robot.leg_length**2 / 12,
        pelvis_inertia / pelvis,
    ]
    return masses, inertias, off


def motion(task, x, pelvis_offset=(0.0, 0.0)):
    """Placements (5, 3) at x (6,), and their derivatives by time."""
    moving = placements(task, x[:3] + 1e-30j * x[3:], pelvis_offset)
    return moving.real, moving.imag / 1e-30


def energy(foot_mass, x):
    """Kinetic and potential energy in J at x (6,)."""
    (masses, inertias, _), (place, velocity) = bodies(TASK.robot, foot_mass), motion(TASK, x)
    sizes = np.column_stack([masses, masses, inertias])
    return np.sum(sizes * velocity**2) / 2 + TASK.robot.gravity * masses @ place[:, 1]


def newton_euler(task, foot_mass, x, torque, moment=0.0, slope=0.0, payload=(0.0, 0.0, 0.0)):
    """Accelerations (3,) of alpha_w, alpha_b, theta, and gaps (12,) that the task's positions would open.

    A moment acts on the wheel, the floor slopes, and the pelvis carries a payload: kg, and where (m).
    """
    robot, tiny = task.robot, 1e-30j
    masses, inertias, off = bodies(robot, foot_mass, payload)
    place, velocity = motion(task, x, off)
    jacobian = np.array([gaps(robot, place, unit.reshape(5, 3), off) for unit in np.eye(15)]).T
    drift = gaps(robot, place + tiny * velocity, velocity, off).imag / tiny.imag

    forces = np.zeros((5, 3))
    forces[:, :2] = -robot.gravity * np.outer(masses, [np.sin(slope), np.cos(slope)])
    forces[LEGS, 2], forces[FOOT, 2], forces[WHEEL, 2] = torque, -torque, moment

    inertia = np.diag(np.column_stack((masses, masses, inertias)).ravel())
    system = np.block([[inertia, jacobian.T], [jacobian, np.zeros((12, 12))]])
    solution = np.linalg.solve(system, np.concatenate((forces.ravel(), -drift)))
    wheel, board, legs = solution[:15].reshape(5, 3)[[WHEEL, BOARD, LEGS], 2]
    return np.array([wheel, board - wheel, legs - board]), jacobian @ velocity.ravel()


@pytest.mark.slow
@given(task=tasks, foot_mass=foot_masses, x=states, u=torques)
@settings(deadline=None, max_examples=20)
def test_accelerations_agree_with_newton_and_euler(task, foot_mass, x, u):
    expected, opening = newton_euler(task, foot_mass, x, u[0])
    np.testing.assert_allclose(opening, 0, atol=1e-12)
    actual = LagrangianBongoboard(task, foot_mass).accelerations(x, u)
    tolerance = 1e-10 * (1 + np.linalg.norm(expected))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance)


# What a modeller may not know

UNKNOWN = Uncertainty(
    masses=0.15,
    foot_mass=2.0,
    slope=0.1,
    ankle_damping=2.0,
    ankle_stiffness=10.0,
    ankle_friction=2.0,
    rolling_resistance=1.0,
    payload_mass=3.0,
    payload_x=0.1,
    payload_y=0.1,
    motor_gain=0.3,
    torque_offset=1.0,
    torque_limit=60.0,
    lag=0.02,
    delay=0.01,
)


def knowing(**values):
    """A model that knows the values of these parameters exactly."""
    uncertain = Uncertainty(**dict.fromkeys(values, 1.0))
    model = LagrangianBongoboard(TASK, foot_mass=1.0, uncertainty=uncertain)
    assert {parameter.name for parameter in model.parameters} == set(values)
    return with_values(model, **values)


@given(
    x=states,
    u=torques,
    slope=st.floats(-0.5, 0.5),
    load=st.tuples(st.floats(0, 10), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
    damping=st.floats(0, 5),
    stiffness=st.floats(-20, 50),
    moment=st.floats(0, 5),
)
@settings(deadline=None, max_examples=15)
def test_disturbed_accelerations_agree_with_newton_and_euler(x, u, slope, load, damping, stiffness, moment):
    """With dry friction at its full strength: rates are large against where it is smoothed."""
    calm = knowing(**dict.fromkeys(MECHANICAL, 0.0))  # which is the paper's
    np.testing.assert_allclose(calm.step(x, u), LagrangianBongoboard(TASK, 1.0).step(x, u), rtol=1e-12)
    x = x + np.where(x[3:] < 0, -20.0, 20.0) @ np.eye(6)[3:]
    friction = 0.5 * moment
    names = ("payload_mass", "payload_x", "payload_y")
    model = knowing(
        slope=slope,
        ankle_damping=damping,
        ankle_stiffness=stiffness,
        ankle_friction=friction,
        rolling_resistance=moment,
        **dict(zip(names, load, strict=True)),
    )
    torque = u[0] - damping * x[5] - stiffness * x[2] - friction * np.sign(x[5])
    expected, opening = newton_euler(TASK, 1.0, x, torque, -moment * np.sign(x[3]), slope, load)
    np.testing.assert_allclose(opening, 0, atol=1e-10)
    np.testing.assert_allclose(model.accelerations(x, u), expected, rtol=1e-4, atol=1e-4)


def test_losses_take_what_they_should_from_the_energy():
    """d theta^2, |d theta| and |d alpha_w| times their coefficients, over the time of a fall."""
    model = knowing(ankle_damping=2.0, ankle_friction=1.0, rolling_resistance=0.5)
    states = fall(model)
    d_alpha_w, d_theta = states[:, 3], states[:, 5]
    power = 2.0 * d_theta**2 + sum(
        size * rate**2 / np.hypot(rate, 0.05) for size, rate in ((1.0, d_theta), (0.5, d_alpha_w))
    )
    lost = np.trapezoid(power, dx=0.001)
    assert lost > 0.01
    assert energy(1.0, states[0]) - energy(1.0, states[-1]) == pytest.approx(lost, rel=1e-4)


def test_what_is_added_to_the_uncertainty_changes_no_earlier_draw():
    """Published trials sample masses and feet with these numbers."""
    plain = LagrangianBongoboard(TASK, uncertainty=Uncertainty(masses=0.15, foot_mass=2.0))
    rng = np.random.default_rng(3)
    names = ["wheel_mass", "board_mass", "foot_mass", "leg_mass", "pelvis_mass", "pelvis_inertia"]
    factors = dict(zip(names, np.exp(0.15 * rng.standard_normal(6)), strict=True))
    foot_mass = rng.uniform(0.0, 2.0)
    expected = LagrangianBongoboard(scaled(**factors), foot_mass)
    drawn = plain.draw(np.random.default_rng(3))
    np.testing.assert_array_equal(drawn.kernel.parameters, expected.kernel.parameters)
    lagging = Uncertainty(masses=0.15, foot_mass=2.0, lag=0.02)
    more = LagrangianBongoboard(TASK, uncertainty=lagging).draw(np.random.default_rng(3))
    np.testing.assert_array_equal(more.kernel.parameters[-11:], expected.kernel.parameters)


def test_priors_are_as_declared():
    """Median or bound, spread and kind of each kind; the motor saturates at most so far below the limit."""
    robot, limit = TASK.robot, float(TASK.input_limit[0])
    priors = {each[0]: each[1:5] for each in LagrangianBongoboard(TASK, uncertainty=UNKNOWN).parameters}
    assert len(priors) == 19
    assert priors["pelvis_inertia"] == ("kg m^2", robot.pelvis_inertia, 0.15, "log_normal")
    assert priors["foot_mass"] == ("kg", 0.0, 2.0, "uniform")
    assert priors["slope"] == ("rad", 0.0, 0.1, "normal")
    assert priors["ankle_damping"] == ("N m s/rad", 0.0, 2.0, "half_normal")
    assert priors["motor_gain"] == ("1", 1.0, 0.3, "log_normal")
    assert priors["torque_limit"] == ("N m", limit - 60.0, 60.0, "uniform")
    (weak,) = LagrangianBongoboard(TASK, uncertainty=Uncertainty(torque_limit=2 * limit)).parameters
    assert weak[2:4] == (0.0, limit)
    assert MODEL.parameters == ()
    with pytest.raises(ValueError, match="is 200 frames; at most 100 are possible"):
        LagrangianBongoboard(TASK, uncertainty=Uncertainty(delay=0.2))


def test_a_motor_acts_on_the_torque():
    """Nothing but its offset, then its gain, too, differs from those of an ideal one."""
    x, u = np.tile(MOVING, (3, 1)), np.array([[-10.0], [0.0], [20.0]])
    ideal, offset = LagrangianBongoboard(TASK, 1.0), knowing(torque_offset=3.0)
    both = knowing(torque_offset=3.0, motor_gain=0.5)
    for model, torque in ((ideal, u), (offset, u + 3.0), (both, 0.5 * u + 3.0)):
        memory = np.zeros((3, model.state_size))
        np.testing.assert_allclose(model.step(x, u), ideal.step(x, torque), rtol=1e-12)
        advanced, after = model.advance(x, u, memory)
        np.testing.assert_allclose(advanced, ideal.step(x, torque), rtol=1e-12)
        assert after.shape == memory.shape
        assert model.model_states(x, u).shape == memory.shape
    assert ideal.model_states(x, u).shape == (3, 0)


def test_what_is_not_sampled_is_not_there_until_it_is_identified():
    uncertainty = Uncertainty(masses=0.15, slope=0.02, lag=0.02, delay=0.01)
    model = LagrangianBongoboard(TASK, uncertainty=uncertainty, sampled=["masses"])
    plain = LagrangianBongoboard(TASK, uncertainty=Uncertainty(masses=0.15))
    for one, other in ((model, plain), (each.draw(np.random.default_rng(1)) for each in (model, plain))):
        assert one.kernel.function is other.kernel.function
        np.testing.assert_array_equal(one.kernel.parameters, other.kernel.parameters)
        assert one.state_size == 0
    identified = model.with_parameters(np.array([parameter.value for parameter in model.parameters]))
    assert identified.state_size == 1 + 10
    assert identified.draw(np.random.default_rng(1)).state_size == 0
    with pytest.raises(ValueError, match=r"^sampled: no uncertainty is called slop; available: masses, "):
        LagrangianBongoboard(TASK, sampled=["slop"])


# The step


@given(x=states, u=torques)
@settings(deadline=None, max_examples=20)
def test_step_is_semi_implicit_euler(x, u):
    before = x.copy()
    rates = x[3:] + TASK.time_step * newton_euler(TASK, 0.0, x, u[0])[0]
    expected = np.concatenate((x[:3] + TASK.time_step * rates, rates))
    np.testing.assert_allclose(MODEL.step(x, u), expected, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(x, before)


# The generated module


@pytest.mark.slow
def test_generated_equations_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "sweeps" / "studies" / "equations_of_motion")
    derive_bongoboard: Any = importlib.import_module("derive")
    for variant in derive_bongoboard.VARIANTS:
        file = derive_bongoboard.FOLDER / variant.file
        assert derive_bongoboard.generate(variant) == file.read_text(encoding="utf-8")


STATES = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(np.array)


@pytest.mark.slow
@given(STATES)
@settings(deadline=None, max_examples=25)
def test_measures_are_those_of_the_pose(study: Study, x: Array) -> None:
    """The board touches the ground with a corner, and leaves the wheel where the contact passes its end.

    The contact is where the wheel's centre falls on the board's underside.
    """
    robot, pose = study.task.robot, study.task.pose(x[:3])
    tangent = np.array([np.cos(pose.board_angle), np.sin(pose.board_angle)])
    normal = np.array([-tangent[1], tangent[0]])
    along, across = tangent * robot.board_length / 2, normal * robot.board_thickness / 2
    lowest = min((pose.board + i * along + j * across)[1] for i in (-1, 1) for j in (-1, 1))
    measures = study.task.measure(x)
    assert measures[0] == pytest.approx(-lowest, abs=1e-12)
    contact = abs((pose.wheel - pose.board) @ tangent)
    assert measures[1] == pytest.approx(contact - robot.board_length / 2, abs=1e-12)
    gap = (pose.board - pose.wheel) @ normal - robot.wheel_radius - robot.board_thickness / 2
    assert gap == pytest.approx(0.0, abs=1e-12)


@given(STATES)
@settings(deadline=None, max_examples=25)
def test_outputs_are_the_pelvis_the_ankle_and_the_foot(study: Study, x: Array) -> None:
    """Velocities by complex step along the motion."""
    h = 1e-30
    moving = study.task.pose(x[:3] + 1j * h * x[3:])
    expected = [moving.pelvis[0].real, moving.pelvis[0].imag / h, x[2], x[5], moving.board_angle.real]
    np.testing.assert_allclose(study.task.output(x), expected, atol=1e-12)


def test_starts_are_drawn_around_the_mean(study: Study) -> None:
    rng = np.random.default_rng(0)
    starts = np.array([study.task.draw_start(rng) for _ in range(1000)])
    np.testing.assert_allclose(starts.mean(axis=0), [0, 0.05, 0, 0, 0, 0], atol=4 * 0.02 / np.sqrt(1000))
    np.testing.assert_allclose(starts.std(axis=0), 0.02, rtol=4 / np.sqrt(2 * 1000))
