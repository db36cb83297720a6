"""Files of others: joints of all kinds, inputs with limits on either side, missing names, no end."""

import time
from pathlib import Path

import numpy as np
import pytest
from errors import one_line
from interpreted import interpreted
from mechanisms import QUADROTOR, cart_pole, mjcf, quadrotor

from simbias.core import Model, StudyWarning
from simbias.core.records import Array
from simbias.learning.bias.none import ZeroBias
from simbias.policy.dynamic_output_feedback import DynamicOutputFeedback
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.mujoco.files import source_files
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.model import Mujoco
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiled import CompiledSimulator

HOVER = np.full(4, 9.81 / 4)  # N of each propeller, for 1 kg


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "quadrotor.xml"
    path.write_text(QUADROTOR)
    return str(path)


def turned(angle: float, axis: tuple[float, float, float]) -> Array:
    """A quaternion (w, x, y, z)."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def test_a_quadrotor_hovers_and_turns_by_its_propellers_drag(file: str) -> None:
    """Motors at sites, whose gears are a force and the torque with it; the free joint has no name."""
    task = quadrotor()
    model, x = Mujoco(task, file), task.start_mean
    np.testing.assert_allclose(model.step(x, HOVER), x, atol=1e-12)
    yaw = model.step(x, HOVER + np.array([1.0, 0.0, 1.0, 0.0]))  # two that turn alike
    lift, turn = 2.0 * task.time_step / 1.0, 2.0 * 0.02 / 0.02 * task.time_step
    np.testing.assert_allclose(yaw[[9, 12]], [lift, turn], rtol=1e-9)


def test_quaternions_turn_as_the_body_does_and_stay_of_unit_length(file: str) -> None:
    """A constant rate about an axis of the body, from any start; a corrected state need not be normalised."""
    task = quadrotor()
    model, x = Mujoco(task, file), task.start_mean.copy()
    x[12] = 3.0  # rad/s about the body's z axis
    for _ in range(50):
        x = model.step(x, HOVER)
    np.testing.assert_allclose(x[3:7], turned(3.0 * 50 * task.time_step, (0, 0, 1)), atol=1e-9)
    scaled = x.copy()
    scaled[3:7] *= 1.2
    np.testing.assert_allclose(model.step(scaled, HOVER), model.step(x, HOVER), atol=1e-12)


@pytest.mark.slow
def test_propellers_push_but_never_pull(file: str) -> None:
    """In lanes as in the law itself; these rollouts are what the engine does with their inputs."""
    task = quadrotor()
    law, model = DynamicOutputFeedback(task), Mujoco(task, file)
    thetas = np.random.default_rng(0).uniform(-1, 1, (8, law.n_parameters))
    starts = np.array([task.draw_start(np.random.default_rng(seed)) for seed in range(8)])
    loop = simulator(Model(task, law, model, ZeroBias(13)))
    assert isinstance(loop, CompiledSimulator)
    with interpreted():
        rollouts = loop.rollouts(thetas, starts)
    inputs = np.concatenate([rollout.inputs for rollout in rollouts])
    assert (inputs.min(), inputs.max()) == (0.0, 6.0)
    for rollout, theta in zip(rollouts, thetas, strict=True):
        controller = law.controller(theta, task.time_step)
        asked = [controller(x) for x in rollout.states[:-1]]
        np.testing.assert_allclose(rollout.inputs, asked, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(rollout.states[1:], model.step(rollout.states[:-1], rollout.inputs))


def test_limits_of_an_input_are_held_against_the_file_on_either_side(file: str) -> None:
    for limits, message in (
        ({"limit": 7.0}, "may be 7; the actuator m1 gives 6"),
        ({"lower": -1.0}, "may be -1; the actuator m1 gives 0"),
        ({"lower": None}, "may be -6; the actuator m1 gives 0"),
    ):
        with pytest.raises(ValueError, match=message):
            Mechanism(quadrotor(**limits), file)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"inputs\.m1: lower is 6; it must be below the limit 6"):
        quadrotor(limit=6.0, lower=6.0)


def test_what_is_no_motor_takes_its_control_as_the_input(tmp_path: Path) -> None:
    """20 V at a DC motor, though it gives no 20 N; of a motor, the line says how volts are declared."""
    volts = {"push": {"unit": "V", "limit": 20.0}}
    motor = '<general name="push" joint="slider" gainprm="0.4" ctrlrange="-20 20" forcerange="-8 8" {}/>'
    affine = 'biastype="affine" biasprm="0 0 -0.3"'
    robot = Mechanism(cart_pole(inputs=volts), mjcf(tmp_path, actuators=motor.format(affine)))
    np.testing.assert_array_equal(robot.controls(np.array([[20.0]])), [[20.0]])
    with pytest.raises(ValueError, match=r'may be 20; the actuator push gives 8 \(V; .* biastype="affine"'):
        Mechanism(cart_pole(inputs=volts), mjcf(tmp_path, actuators=motor.format("")))


def test_states_and_inputs_are_in_units_of_the_engine(tmp_path: Path) -> None:
    """It knows no others: degrees were taken for radians."""
    units = {"position": "m", "angle": "rad", "d_position": "m/s", "d_angle": "rad/s"}
    for name, unit, right in (("angle", "deg", "rad"), ("position", "mm", "m"), ("d_angle", "rpm", "rad/s")):
        states = {each: {"unit": given} for each, given in (units | {name: unit}).items()}
        with pytest.raises(
            ValueError, match=f"^the task's state {name} is in {unit}; in .* it is in {right}$"
        ):
            Mechanism(cart_pole(states=states), mjcf(tmp_path))
    hinge = mjcf(tmp_path, actuators='<motor name="push" joint="hinge"/>')
    for unit in ("mN m", "N"):
        with pytest.raises(
            ValueError, match=f"^the task's input force is in {unit}; the motor push has N m$"
        ):
            Mechanism(cart_pole(inputs={"force": {"unit": unit, "limit": 1.0}}), hinge)
    Mechanism(cart_pole(inputs={"force": {"unit": "Nm", "limit": 1.0}}), hinge)


def test_what_has_no_name_in_a_file_is_called_by_what_it_moves(tmp_path: Path) -> None:
    """As the motors of Gymnasium's reacher; others beside it by number."""
    motors = '<motor joint="slider" gear="20" ctrlrange="-1 1"/><motor joint="slider"/>'
    inputs = {name: {"unit": "N", "limit": 20.0} for name in ("force", "other")}
    robot = Mechanism(cart_pole(inputs=inputs), mjcf(tmp_path, actuators=motors), ["slider", "hinge"])
    assert [robot.model.actuator(index).name for index in range(2)] == ["slider", "actuator_1"]


def test_a_model_that_never_ends_is_refused_at_once(tmp_path: Path) -> None:
    cart = Path(mjcf(tmp_path)).read_text()
    (tmp_path / "part.xml").write_text('<mujoco><composite count="1000 1000 1000"/></mujoco>')
    (tmp_path / "copied.xml").write_text(
        '<mujoco><worldbody><body name="b"><replicate count="1000"><geom size="1"/></replicate></body>'
        "</worldbody></mujoco>"
    )
    twice = '<replicate count="1000"><replicate count="1000"><geom size="1"/></replicate></replicate>'
    attached = '<replicate count="1000"><attach model="m" body="b" prefix="p"/></replicate>'
    begin = time.monotonic()
    for text, message in (
        ('<option timestep="1e-12"/>', r"a frame of 0.02 s would take 2e\+10 steps of 1e-12 s"),
        (f"<worldbody>{twice}</worldbody>", r"replicate makes 1e\+06 copies, more than 1e\+04"),
        (
            '<asset><hfield name="hills" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
            r"hfield 'hills' makes 1e\+10 cells",
        ),
        ('<include file="part.xml"/>', r"composite makes 1e\+09 copies"),
        ('<include file="endless.xml"/>', r"endless.xml includes itself"),
        (
            f'<asset><model name="m" file="copied.xml"/></asset><worldbody>{attached}</worldbody>',
            r"replicate makes 1e\+06 copies",
        ),
    ):
        (tmp_path / "endless.xml").write_text(cart.replace("</mujoco>", f"{text}</mujoco>"))
        with one_line(message, ValueError):
            Mechanism(cart_pole(), str(tmp_path / "endless.xml"))
    assert time.monotonic() - begin < 10.0


def test_a_mesh_whose_path_is_stripped_is_one_of_the_files(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="package://arm/meshes/link.stl"/></geometry></visual>'
    for strips, files in (("true", ["arm.urdf", "link.stl"]), ("false", ["arm.urdf"])):
        compiler = f'<mujoco><compiler strippath="{strips}"/></mujoco>'
        text = f'<robot name="arm">{compiler}<link name="arm">{mesh}</link></robot>'
        (tmp_path / "arm.urdf").write_text(text)
        (tmp_path / "link.stl").touch()
        assert [path.name for path in source_files(str(tmp_path / "arm.urdf"))] == files


def test_sensors_and_sites_are_outputs_and_criteria(file: str) -> None:
    """What the engine says of a state; in rollouts as in the law."""
    sensors = {"file": file, "sites": ["m1"]}
    outputs = {"tilt": {"value": "up[2]"}, "corner": {"value": "m1[2] - z"}, "turn": {"value": "gyro[2]"}}
    task = quadrotor(sensors=sensors, outputs=outputs, failure={"tips": {"value": "up[2]", "below": 0.9}})
    x = np.tile(task.start_mean, (2, 1))
    x[1, 3:7], x[:, 12] = turned(0.3, (1, 0, 0)), 0.7
    expected = [[1.0, 0.0, 0.7], [np.cos(0.3), 0.1 * np.sin(0.3), 0.7]]
    np.testing.assert_allclose(task.output(x), expected, atol=1e-9)
    law, theta = OutputFeedback(task), np.full(12, 0.5)
    with pytest.warns(StudyWarning, match=r"Declared.measure \(.*: the engine computes sensors and sites\)"):
        loop = join([simulator(Model(task, law, Mujoco(task, file), ZeroBias(13)))])
    (rollout,) = loop.rollouts(theta[None], task.start_mean[None], np.zeros(1, np.int64))
    np.testing.assert_allclose(rollout.inputs[0], law.act(theta, rollout.states[0], 0.0, np.zeros(0))[0])
    assert rollout.failure is None or task.measure(rollout.states[-1]) > -0.9
    for wrong, message in (
        ({"sensors": ["felt"]}, "sensor 'felt' measures forces or accelerations; available: up, gyro"),
        ({"sensors": ["nose"]}, "sensor 'nose' does not exist"),
        ({"sites": ["tip"]}, "no site 'tip'; available: m1, m2, m3, m4"),
        ({"sensors": ["up", "up"]}, r"up\[0\]: two things have this name"),
        ({"sites": ["m1", "m1"]}, r"m1\[0\]: two things have this name"),
    ):
        with pytest.raises(ValueError, match=message):
            quadrotor(sensors={"file": file, **wrong})
