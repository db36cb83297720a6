"""MuJoCo as a model: against equations of motion, itself, and what a file cannot be; and as hardware."""

import ctypes
import gc
import logging
import os
import re
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from errors import one_line
from in_numpy import OfAllLanes
from interpreted import interpreted, predicted_as_plain
from mechanisms import DOUBLE, LIFT, MOTOR, URDF, cart_pole, mjcf
from models import Sliding
from numba import get_num_threads, set_num_threads

import simbias
from simbias.core import FittedBias, Model
from simbias.core.records import Array, Indices, Rollout
from simbias.policy.output_feedback import OutputFeedback
from simbias.robots.cartpole import CartPole
from simbias.robots.mujoco import parameters as files
from simbias.robots.mujoco.hardware import Mujoco as Hardware
from simbias.robots.mujoco.kernel import FREE, TAKEN
from simbias.robots.mujoco.model import Mujoco
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler import formulas_of
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import PredictionModel, Windows
from simbias.trial.study import Study


def points(k: int, scale: float = 0.5) -> tuple[Array, Array]:
    """States (k, 4) and forces (k, 1)."""
    rng = np.random.default_rng(0)
    return scale * rng.normal(size=(k, 4)), 10 * rng.uniform(-1, 1, (k, 1))


def test_it_moves_as_the_equations_of_motion_say(tmp_path: Path) -> None:
    """An independent implementation: both by Runge and Kutta's method, so they converge to each other."""
    task = cart_pole()
    file = mjcf(tmp_path, damping=0.3, step=0.02)
    engine = Mujoco(task, file, values={"tip.mass": 0.0, "tip.inertia": 1e-12})
    equations = CartPole(task, 2.0, 0.5, 0.8, 0.3, 0.3)
    x, u = points(20)
    np.testing.assert_allclose(engine.step(x, u), equations.step(x, u), rtol=1e-6, atol=1e-7)


def test_a_state_moves_alike_alone_and_among_others(tmp_path: Path) -> None:
    """On one thread or several, whatever was stepped before."""
    model = Mujoco(cart_pole(), mjcf(tmp_path))
    x, u = points(80)
    together = model.step(x, u)
    for row in (3, 79):
        np.testing.assert_array_equal(model.step(x[row], u[row]), together[row])
    np.testing.assert_array_equal(
        model.step(x.reshape(4, 20, 4), u.reshape(4, 20, 1)).reshape(80, 4), together
    )


@cache
def search(*overrides: str) -> Study:
    """Of the double cart-pole, on models that differ."""
    robust = "evaluation=domain_randomization"
    return simbias.load(["preset=double_cartpole", "tracking=none", robust, *overrides])


def models_of(study: Study, bias: FittedBias | None = None) -> list[Model]:
    model, rng = study.model(bias), np.random.default_rng(0)
    return [replace(model, nominal=study.nominal.draw(rng)) for _ in range(3)]


def candidates(study: Study, k: int) -> tuple[Array, Array, Indices]:
    """Policies (k, p), of which some are mild, starts (k, n) and scenarios (k,)."""
    rng = np.random.default_rng(1)
    lower, upper = study.policy.bounds
    thetas = rng.uniform(lower, upper, (k, len(lower))) * rng.uniform(0.01, 1.0, (k, 1))
    starts = np.array([study.task.draw_start(rng) for _ in range(k)])
    return thetas, starts, rng.integers(0, 3, k)


@pytest.mark.slow
def test_compiled_rollouts_are_the_plain_ones() -> None:
    """In several scenarios, without a bias and (as it is written) with one: alike, at the same costs.

    On one thread or several, whatever is simulated beside; models live as long as the compiled loop does.
    """
    study = search("identification=none", "bias=none")
    asked = candidates(study, 24)
    for learns in (False, True):
        models = models_of(study, OfAllLanes(6) if learns else None)
        reference, expected = PlainSimulator(models, [None] * 3).costs(study.cost, *asked)
        compiled = join([simulator(model, cost=study.cost) for model in models])
        assert isinstance(compiled, CompiledSimulator)
        del models
        gc.collect(1)
        with interpreted() if learns else nullcontext():
            costs, frames = compiled.costs(study.cost, *asked)
        np.testing.assert_array_equal(frames, expected)
        np.testing.assert_allclose(costs, reference, rtol=1e-9)
        assert len(np.unique(frames)) > 10
        if not learns:
            alone, _ = compiled.costs(study.cost, *(each[17:18] for each in asked))
            assert alone[0] == costs[17]
            before = get_num_threads()
            set_num_threads(1)
            np.testing.assert_array_equal(compiled.costs(study.cost, *asked)[0], costs)
            set_num_threads(before)
    thetas, starts, _ = asked
    for rollout in study.simulator().rollouts(np.zeros_like(thetas), starts)[::10]:
        stepped = study.nominal.step(rollout.states[:-1], rollout.inputs)
        np.testing.assert_array_equal(rollout.states[1:], stepped)  # to the last bit


@pytest.mark.slow
def test_a_frame_with_contacts_is_the_engines_to_the_last_bit() -> None:
    """Of the loop that is compiled."""
    study = simbias.load(["preset=biped", "tracking=none", "task.horizon=20"])
    loop, (_, starts, _) = study.simulator(), candidates(study, 10)
    assert isinstance(loop, CompiledSimulator)
    with interpreted():
        rollouts = loop.rollouts(np.zeros((10, study.policy.n_parameters)), starts)
    for rollout in rollouts:
        assert rollout.frames > 3
        stepped = study.nominal.step(rollout.states[:-1], rollout.inputs)
        np.testing.assert_array_equal(rollout.states[1:], stepped)


@pytest.mark.slow
def test_predictions_of_a_record_are_the_plain_ones() -> None:
    """As an identification asks for them: each model along the inputs of an experiment."""
    study = search()
    thetas, starts, _ = candidates(study, 3)
    windows = Windows.of(study.simulator().rollouts(0.01 * thetas, starts), 4, 2)
    scenarios = [PredictionModel(model.nominal) for model in models_of(study)]
    assert len(windows) >= 3
    predicted_as_plain(scenarios, windows, 1e-12, 1e-12)


@pytest.mark.slow
def test_a_lane_without_a_rollout_does_not_ask_the_engine() -> None:
    """A frame takes as long as a thousand of other models; each rollout asks for one in vain, as it ends."""
    study = search()
    thetas, starts, _ = candidates(study, 5)
    (library,) = Path(mujoco.__file__).parent.glob("*mujoco.*[0-9]*")
    asked: list[None] = []
    count = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(lambda *_: asked.append(None))
    callback = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_control")
    callback.value = ctypes.cast(count, ctypes.c_void_p).value
    try:
        _, frames = study.simulator().costs(study.cost, thetas, starts)
    finally:
        callback.value = None
    substeps = round(study.task.time_step / 0.01)
    assert len(asked) == 4 * substeps * (frames.sum() + 5)  # 4: the file integrates by Runge and Kutta


@pytest.mark.slow
def test_what_blows_up_in_compiled_code_is_no_number() -> None:
    study = search()
    start = study.task.start_mean.copy()
    start[3] = 2e4
    rollout = study.simulator().rollout(np.zeros(study.policy.n_parameters), start)
    assert rollout.failed_at == 1
    assert np.isnan(rollout.states[1]).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_process_that_is_forked_does_not_wait_for_places_of_its_parents_threads() -> None:
    """A thread of the parent's that works there does not exist in the child."""
    study = search("task.horizon=3")
    places = study.nominal._places  # type: ignore[attr-defined]
    places.table[:, 0] = TAKEN
    child = os.fork()
    if not child:
        os._exit(int(places.table[:, 0].any()))
    places.table[:, 0] = FREE
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_parameters_are_what_was_declared(tmp_path: Path) -> None:
    """Their values are the file's; a positive one's prior is log-normal, of zero half a normal one.

    Of several patterns that fit a name, the last one counts.
    """
    declared = {"p*.mass": 0.1, "pole.mass": 0.3, "hinge.damping": 2.0}
    model = Mujoco(cart_pole(), mjcf(tmp_path), uncertainty=declared)
    mass, damping = model.parameters
    assert mass[:5] == ("pole.mass", "kg", 0.5, 0.3, "log_normal")
    assert damping[:5] == ("hinge.damping", "N m s/rad", 0.0, 2.0, "half_normal")
    (sliding,) = Mujoco(cart_pole(), mjcf(tmp_path), uncertainty={"slider.damping": 2.0}).parameters
    assert sliding.unit == "N s/m"
    changed = model.with_parameters(np.array([1.0, 0.7]))
    equal = Mujoco(cart_pole(), mjcf(tmp_path), values={"pole.mass": 1.0, "hinge.damping": 0.7})
    x, u = points(5)
    np.testing.assert_array_equal(changed.step(x, u), equal.step(x, u))
    same = model.with_parameters(np.array([0.5, 0.0]))
    np.testing.assert_allclose(same.step(x, u), model.step(x, u), rtol=1e-12)


def test_each_draw_is_of_bodies(tmp_path: Path) -> None:
    """Masses are positive; no principal moment of inertia exceeds the two others' sum."""
    wide = {"*.mass": 1.0, "*.size": 1.0, "*.inertia": 2.0}
    model, rng = Mujoco(cart_pole(), mjcf(tmp_path), uncertainty=wide), np.random.default_rng(0)
    for _ in range(20):
        drawn = model.draw(rng)
        assert isinstance(drawn, Mujoco)
        engine = drawn._robot.model
        moments = np.sort(engine.body_inertia[1:], axis=1)
        assert (engine.body_mass[1:] > 0).all()
        assert (moments > 0).all()
        assert (moments[:, 2] <= moments[:, :2].sum(axis=1) * (1 + 1e-12)).all()


def test_a_heavier_body_has_more_inertia_and_a_larger_one_hangs_farther(tmp_path: Path) -> None:
    """As a file says that has these numbers."""
    task, x, u = cart_pole(), *points(10)
    longer = Mujoco(task, mjcf(tmp_path, length=1.2))
    scaled = Mujoco(task, mjcf(tmp_path, length=0.8), values={"pole.size": 1.5})
    np.testing.assert_allclose(scaled.step(x, u), longer.step(x, u), rtol=1e-9)
    weak = Mujoco(task, mjcf(tmp_path), factors={"push.gain": 0.5})
    np.testing.assert_allclose(weak.step(x, u), Mujoco(task, mjcf(tmp_path)).step(x, u / 2), rtol=1e-12)


@pytest.mark.parametrize("body", ["cart", "pole"])
def test_a_larger_body_does_not_depend_on_where_its_origin_is(body: str) -> None:
    """Beside its joint and turned, or at it: the joint stays where it is on the parent."""
    places = []
    moved = ('pos="0.2 0 0.1" euler="0 0 90"', 0.2, "1 0 0")
    for origin, y, axis in (('pos="0 0 0.1"', 0.0, "0 1 0"), moved):
        model = mujoco.MjModel.from_xml_string(f"""
          <mujoco><worldbody><body name="cart"><joint type="slide" axis="1 0 0"/><geom size="0.1"/>
          <body name="pole" {origin}><joint pos="0 {y} 0" axis="{axis}"/><geom size="0.1" pos="0 {y} 0.3"/>
          <body pos="0 {y} 0.6"><geom size="0.1"/></body></body></body></worldbody></mujoco>""")
        files.put_values(model, {f"{body}.size": 1.5})
        data = mujoco.MjData(model)
        data.qpos[:] = 0.1, 0.7
        mujoco.mj_forward(model, data)
        places.append(np.concatenate([data.xanchor, data.geom_xpos]))
    np.testing.assert_allclose(places[1], places[0], atol=1e-12)
    assert places[0][1, 2] == pytest.approx({"cart": 0.15, "pole": 0.1}[body])


def test_friction_of_a_ball_joint_is_about_all_axes() -> None:
    """So are damping and armature; of a geom's three numbers, the first one alone is sliding friction."""
    model = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body><joint name="hip" type="ball"/><geom name="foot" size="0.1"/></body>
      </worldbody></mujoco>""")
    of_hip = {"hip.damping": 0.5, "hip.friction": 0.2, "hip.armature": 0.1}
    files.put_values(model, of_hip | {"foot.contact_friction": 0.7})
    for field, value in (model.dof_damping, 0.5), (model.dof_frictionloss, 0.2), (model.dof_armature, 0.1):
        np.testing.assert_array_equal(field, value)
    np.testing.assert_allclose(model.geom_friction[0], [0.7, 0.005, 0.0001])


def test_factors_multiply_what_is_set_and_each_other() -> None:
    model = mujoco.MjModel.from_xml_string(LIFT)
    factors = {"*.mass": 1.5, "body.mass": 2.0}
    assert files.changes(model, {"body.mass": 3.0}, factors) == {"body.mass": 9.0}
    assert files.changes(model, {}, factors) == {"body.mass": 6.0}


SERVO = '<position name="push" joint="slider" gear="2" kp="50" dampratio="1" forcerange="-3 3"/>'
VOLTAGE = '<general name="push" joint="slider" gainprm="0.4" biastype="affine" biasprm="0 0 -0.3"/>'


@pytest.mark.parametrize("actuator", [SERVO, VOLTAGE])
def test_a_gain_is_a_share_of_the_whole_force(actuator: str, tmp_path: Path) -> None:
    """Also of what depends on position and speed, and of its limit; so does the file that is written."""
    model, states = Mujoco(cart_pole(), mjcf(tmp_path, actuators=actuator)), points(20)
    weak = Mujoco(cart_pole(), mjcf(tmp_path, actuators=actuator), factors={"push.gain": 0.5})
    (tmp_path / "weak.xml").write_text(weak.mjcf())
    written = Mujoco(cart_pole(), str(tmp_path / "weak.xml"))
    forces = []
    for each in model, weak, written:
        engine = each._robot.model
        data = mujoco.MjData(engine)
        for x, u in zip(*states, strict=True):
            data.qpos[:], data.qvel[:], data.ctrl[:] = x[:2], x[2:], u
            mujoco.mj_forward(engine, data)
            forces.append(data.qfrc_actuator[0])
    full, half, read = np.reshape(forces, (3, -1))
    assert np.ptp(full) > 1
    np.testing.assert_allclose(half, full / 2, rtol=1e-12)
    np.testing.assert_allclose(read, half, rtol=1e-5)
    np.testing.assert_allclose(written.step(*states), weak.step(*states), rtol=1e-4, atol=1e-6)


def test_a_motor_at_a_site_pushes_along_its_gear(tmp_path: Path) -> None:
    """As a propeller, which drags as well: 3 N lift 2 kg by 1.5 m/s^2, in units of neither gear nor gain."""
    file = tmp_path / "lift.xml"
    file.write_text(LIFT)
    states = {"height": {"unit": "m"}, "d_height": {"unit": "m/s"}}
    task = cart_pole(states=states, failure={"far": {"value": "abs(height)", "above": 5.0}})
    after = Mujoco(task, str(file)).step(np.zeros(2), np.array([3.0]))
    assert after[1] == pytest.approx(3.0 / 2.0 * 0.02)
    half = Mujoco(task, str(file), factors={"lift.gain": 0.5}).step(np.zeros(2), np.array([3.0]))
    assert half[1] == pytest.approx(after[1] / 2)
    file.write_text(LIFT.replace("-5 5", "-4 4"))
    with pytest.raises(ValueError, match="the task's input may be 20; the actuator lift gives 16"):
        Mujoco(task, str(file))


@pytest.mark.parametrize(
    ("joint", "gear", "units"),
    [
        ("ball", "0.6 0.8 0", [*4 * [""], *3 * ["rad/s"]]),
        ("free", "0 0 2 0 0 0", [*3 * ["m"], *4 * [""], *3 * ["m/s"], *3 * ["rad/s"]]),
    ],
)
def test_a_motor_on_a_ball_or_a_free_joint_pushes_along_its_gear(
    joint: str, gear: str, units: list[str], tmp_path: Path
) -> None:
    """With the task's input in N m or N; a gear of zero is refused."""
    file = tmp_path / "body.xml"
    own = '<inertial pos="0 0 0" mass="2" diaginertia="2 2 2"/>'
    text = (
        f'<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="it" type="{joint}"/>{own}</body>'
        f'</worldbody><actuator><motor name="push" joint="it" gear="{gear}"/></actuator></mujoco>'
    )
    file.write_text(text)
    states = {f"x{i}": {"unit": unit} for i, unit in enumerate(units)}
    task = cart_pole(states=states, failure={"far": {"value": "abs(x0)", "above": 5.0}}, drawing=None)
    start = np.zeros(len(units))
    start[units.index("")] = 1.0  # the quaternion of no turn
    after = Mujoco(task, str(file)).step(start, np.array([3.0]))
    rates = [unit.endswith("/s") for unit in units]
    assert np.linalg.norm(after[rates]) == pytest.approx(3.0 / 2.0 * 0.02)
    file.write_text(text.replace(gear, "0 0 0 0 0 0"))
    with pytest.raises(ValueError, match="the motor push has a gear or a gain of zero"):
        Mujoco(task, str(file))


def test_what_has_blown_up_is_no_number(tmp_path: Path) -> None:
    """The engine itself would begin anew at its initial state, as if nothing had happened."""
    model = Mujoco(cart_pole(), mjcf(tmp_path))
    x, u = points(3)
    x[1], x[2, 3] = np.nan, 1e6
    after = model.step(x, u)
    assert np.isfinite(after[0]).all()
    assert np.isnan(after[1:]).all()
    assert np.isnan(model.step(x[1:], u[1:])).all()


def test_a_urdf_has_motors_where_its_joints_are_named(tmp_path: Path) -> None:
    """A force F makes 2 kg faster by F t / 2, within the effort that the file allows."""
    file = tmp_path / "slider.urdf"
    file.write_text(URDF)
    states = {"position": {"unit": "m"}, "d_position": {"unit": "m/s"}}
    task = cart_pole(states=states, failure={"far": {"value": "abs(position)", "above": 5.0}})
    after = Mujoco(task, str(file), actuators=["rail"]).step(np.zeros(2), np.array([3.0]))
    assert after[1] == pytest.approx(3.0 / 2.0 * 0.02)
    mesh = '<collision><geometry><mesh filename="package://a/b.stl"/></geometry></collision>'
    file.write_text(URDF.replace('<link name="cart">', f'<link name="cart">{mesh}'))
    with pytest.raises(ValueError, match=r"b\.stl' \(motion needs no geometry: visual and collision may "):
        Mujoco(task, str(file), actuators=["rail"])
    file.write_text(URDF.replace('effort="20"', 'effort="9"'))
    with pytest.raises(ValueError, match="the task's input may be 20; the actuator rail gives 9"):
        Mujoco(task, str(file), actuators=["rail"])
    with pytest.raises(ValueError, match=r"slider\.urdf has no actuators: name the joints to put "):
        Mujoco(task, str(file))


def test_a_tendons_limit_is_that_of_its_motor(tmp_path: Path) -> None:
    """As a joint's is."""
    tendon = (
        '<tendon><fixed name="rope" actuatorfrcrange="-7 7"><joint joint="slider" coef="1"/></fixed></tendon>'
    )
    motor = '<actuator><motor name="push" tendon="rope" gear="2"/></actuator>'
    file = Path(mjcf(tmp_path))
    file.write_text(re.sub("<actuator>.*</actuator>", tendon + motor, file.read_text(), flags=re.DOTALL))
    with pytest.raises(ValueError, match="the task's input may be 20; the actuator push gives 7"):
        Mujoco(cart_pole(), str(file))


def test_a_bad_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody><body/></mujoco>")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"file": str(tmp_path / "broken.xml")}, "broken.xml: "),
        ({"file": "no.xml"}, f"no such file: no.xml, neither in {Path.cwd()} nor .*; give --config-dir"),
        ({"file": str(tmp_path / "no.xml")}, "no such file: .*/no.xml$"),
        ({"file": "nosuchpackage:a.xml"}, "the package nosuchpackage is not installed"),
        (
            {"file": DOUBLE},
            "the task has 4 states; positions and velocities of the joints slider, hinge, hin",
        ),
        ({"joints": ["slider"]}, "joint hinge: all joints must be states"),
        ({"joints": ["slider", "knee"]}, "joints: .* has no 'knee'; it has slider, hinge"),
        ({"actuators": ["pull"]}, "actuators: .* has no 'pull'; it has push"),
        ({"actuators": ["push", "push"]}, "actuators: 'push' is named twice"),
        ({"values": {"pole.colour": 1.0}}, "no parameter is called 'pole.colour'; available: body.mass, "),
        ({"uncertainty": {"knee.*": 1.0}}, "no parameter is called 'knee.*'"),
    ]
    for arguments, message in cases:
        with one_line(message, ValueError):
            Mujoco(cart_pole(), **{"file": mjcf(tmp_path), **arguments})
    servo = '<position name="push" joint="slider" kp="10" timeconst="0.1"/>'
    for limit, actuators, message in (
        (30.0, MOTOR, r"the task's input may be 30; the actuator push gives 20 \(N; a motor's inputs are"),
        (20.0, servo, "actuators with a state of their own are not supported: push; remove"),
        (20.0, "", "the task has 1 inputs"),
    ):
        with one_line(message, ValueError):
            task = cart_pole(inputs={"force": {"unit": "N", "limit": limit}})
            Mujoco(task, mjcf(tmp_path, actuators=actuators))


def test_a_task_reads_its_states_in_the_order_of_the_models_joints(tmp_path: Path) -> None:
    """As their names say; where they do not, another order than the model's is refused."""
    file = mjcf(tmp_path, length=0.8)
    units = {"hinge": "rad", "slider": "m", "d_hinge": "rad/s", "d_slider": "m/s"}
    states = {name: {"unit": unit} for name, unit in units.items()}
    far = {"far": {"value": "abs(slider)", "above": 1.0}}
    task = cart_pole(states=states, figure={"file": file}, failure=far)
    x = np.array([0.3, 0.5, 0.0, 0.0])
    foot = task.points(x)["rod"][1]
    np.testing.assert_allclose(foot, [0.5, 0.0], atol=1e-12)
    assert Mujoco(task, file).step(x, np.array([20.0]))[3] > 0
    other = tmp_path / "other.xml"  # a figure of other joints
    other.write_text(Path(file).read_text().replace('name="hinge"', 'name="knee"'))
    for read in ({"figure": {"file": file}}, {"figure": {"file": str(other)}, "sensors": {"file": file}}):
        with one_line("joints: hinge, slider must be in the order of task.figure or task.sens", ValueError):
            Mujoco(cart_pole(**read), file, joints=["hinge", "slider"])


def test_a_policy_that_predicts_by_the_engine_is_compiled_but_no_code() -> None:
    predicts = ["policy=mlp", "policy.observer=kalman", "policy.latency=0.02"]
    study = simbias.load(["preset=double_cartpole", *predicts, "tracking=none"])
    rng, model = np.random.default_rng(0), study.first_model()
    thetas = rng.uniform(-1.0, 1.0, (20, study.policy.n_parameters))
    starts = np.stack([study.task.draw_start(rng) for _ in thetas])
    compiled = CompiledSimulator.of(model, None)
    assert compiled
    plain = PlainSimulator([model], [None]).rollouts(thetas, starts)
    assert max(rollout.frames for rollout in plain) > 5
    for made, expected in zip(compiled.rollouts(thetas, starts), plain, strict=True):
        np.testing.assert_allclose(made.states, expected.states, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(made.inputs, expected.inputs, rtol=1e-9, atol=1e-9)
    why = formulas_of(study.policy, study.task, thetas[0])
    assert "it predicts with a model that has no formula, such as MuJoCo's" in str(why)


def test_a_compiled_policy_keeps_the_models_that_it_calls() -> None:
    study = simbias.load(["preset=double_cartpole", "tracking=none"])
    policy = Sliding(study.task, study.nominal)
    model, theta = replace(study.first_model(), policy=policy), np.full((1, policy.n_parameters), 0.1)
    start = study.task.start_mean[None]
    compiled = CompiledSimulator.of(model, None)
    assert compiled
    gc.collect()
    (made,), (expected,) = (
        each.rollouts(theta, start) for each in (compiled, PlainSimulator([model], [None]))
    )
    np.testing.assert_allclose(made.states, expected.states, rtol=1e-9, atol=1e-9)
    assert made.frames > 2


def test_without_mujoco_it_is_said_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    files.mujoco.cache_clear()
    with pytest.raises(ValueError, match=r"MuJoCo is not installed .*: pip install 'simbias\[mujoco\]'"):
        Mujoco(cart_pole(), "any.xml")
    files.mujoco.cache_clear()


START = np.array([0.0, 0.1, 0.0, 0.0])
THETA = np.array([-0.5, -3.0, -1.0, -1.5])


def run(folder: Path, theta: np.ndarray = THETA, seed: int = 0, **gap: Any) -> Rollout:
    task = cart_pole()
    hardware = Hardware(task, mjcf(folder), **gap)
    return hardware.run(OutputFeedback(task), theta, START, np.random.default_rng(seed))


def test_it_is_the_nominal_model_but_for_its_gap(tmp_path: Path) -> None:
    """Other parameters are those of a model with them; a delayed input acts so many frames later."""
    other: dict[str, Any] = {"values": {"hinge.damping": 0.4}, "factors": {"*.mass": 1.3, "push.gain": 0.4}}
    for delay, gap in ((0, {}), (3, {}), (0, other)):
        made = run(tmp_path, delay=delay, **gap)
        model = Mujoco(cart_pole(), mjcf(tmp_path), **gap)
        assert made.frames > 5
        acted = np.concatenate([np.zeros((delay, 1)), made.inputs])[: made.frames]
        predicted = model.step(made.states[:-1], acted)
        np.testing.assert_allclose(made.states[1:], predicted, rtol=1e-12, atol=1e-12)


def test_an_unstable_simulation_leaves_no_file(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    robot = Hardware(cart_pole(), mjcf(folder))
    with caplog.at_level(logging.INFO):
        robot.run(
            OutputFeedback(cart_pole()), THETA, np.array([0.0, 0.1, 1e12, 0.0]), np.random.default_rng(0)
        )
    assert "The simulation is unstable" in caplog.text
    assert not (folder / "MUJOCO_LOG.TXT").exists()
