"""Motors and sensors whose parameters are known, identified with a robot's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from interpreted import interpreted
from mechanisms import cart_pole, mjcf
from pendulum import NOISE, QUICK, pendulum

from simbias.core import Nominal
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import SHIFT, Identified, KnownPrior
from simbias.learning.identification.rig import Motor, Rig, Sensor
from simbias.robots.mujoco.model import Mujoco
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict
from simbias.trial.study import Study

MOTOR = Motor(0.2, 0.1, 0.02, 0.01, "vel1", 0.3, 0.2)
SENSORS = {"pos1": Sensor(0.05, 0.1), "vel2": Sensor(0.1)}


@pytest.fixture(scope="module")
def study() -> Study:
    return pendulum("identification=posterior")


def at(rig: Rig, **values: float) -> Rig:
    """The rig with some parameters set."""
    named = {parameter.name: parameter.value for parameter in rig.parameters}
    return rig.with_parameters(np.array(list((named | values).values())))


def recorded(rig: Nominal, rng: np.random.Generator, frames: int = 1000, noise: Array = NOISE) -> Rollout:
    """A rig under smooth random torques."""
    t = 0.002 * np.arange(frames)[:, None]
    u = np.sum([0.7 * np.sin(rng.uniform(2, 20, 2) * t + rng.uniform(0, 6, 2)) for _ in range(4)], axis=0)
    states, memory = [np.zeros(4)], np.zeros(rig.state_size)
    for each in u:
        y, memory = rig.advance(states[-1], each, memory)
        states.append(y)
    return Rollout(np.array(states) + noise * rng.standard_normal((frames + 1, 4)), u)


def test_an_ideal_rig_is_the_model(study: Study) -> None:
    rig, rng = Rig(study.task, study.nominal, {"tau1": MOTOR}, SENSORS), np.random.default_rng(0)
    x, u = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    np.testing.assert_allclose(rig.step(x, u), study.nominal.step(x, u), rtol=1e-12)


def test_the_rigs_kernel_is_the_plain_one(study: Study) -> None:
    """With all that a rig may have, and with sensors alone."""
    rng = np.random.default_rng(0)
    whole = at(
        Rig(study.task, study.nominal, {"tau1": MOTOR}, SENSORS),
        **{"tau1.gain": 0.8, "tau1.offset": 0.05, "tau1.lag": 0.01, "tau1.delay": 0.005},
        **{"tau1.stribeck": 0.1, "tau1.load": 0.2, "pos1.offset": 0.05, "vel2.gain": 1.1},
    )
    seen = at(Rig(study.task, study.nominal, {}, SENSORS), **{"pos1.offset": 0.05, "vel2.gain": 1.1})
    for rig in (whole, seen):
        assert rig.kernel is not None
        windows = Windows.of([recorded(rig, rng, 100)], 50, 5)
        with interpreted():
            made = predict([PredictionModel(rig)], windows)
        np.testing.assert_allclose(made, plain([PredictionModel(rig)], windows), rtol=1e-8, atol=1e-10)


def test_what_sensors_say_is_offset_and_scaled(study: Study) -> None:
    rig = at(Rig(study.task, study.nominal, {}, SENSORS), **{"pos1.offset": 0.1, "vel2.gain": 1.2})
    x, u = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.1, 0.2])
    y = x * [1, 1, 1, 1.2] + [0.1, 0, 0, 0]
    np.testing.assert_allclose(
        rig.step(y, u), study.nominal.step(x, u) * [1, 1, 1, 1.2] + [0.1, 0, 0, 0], rtol=1e-12
    )


def test_friction_brakes_and_falls_with_the_velocity(study: Study) -> None:
    """Never an acceleration along the velocity; Stribeck's half gone at its velocity."""
    motors = {"tau1": Motor(velocity="vel1", stribeck=1.0, load=1.0)}
    rig = Rig(study.task, study.nominal, motors, {})
    x, u = np.array([0.0, 0.0, 0.2, 0.0]), np.array([0.5, 0.0])
    changes = [
        (at(rig, **{name: value}).step(x, u) - study.nominal.step(x, u))[2]
        for name, value in (("tau1.stribeck", 0.1), ("tau1.stribeck", 0.2), ("tau1.load", 0.1))
    ]
    assert changes[0] < 0
    assert changes[1] == pytest.approx(2 * changes[0], rel=1e-3)
    assert changes[2] == pytest.approx(changes[0], rel=1e-3)  # half of 0.1 N m, and a tenth of 0.5 N m


@pytest.mark.slow
def test_they_come_back() -> None:
    """All of them together, beside the pendulum's eleven parameters, from two seconds."""
    true = {"tau1.offset": 0.15, "tau1.lag": 0.015, "tau1.load": 0.25, "pos1.offset": 0.08}
    true |= {"tau2.gain": 0.75, "tau2.delay": 0.006, "tau2.stribeck": 0.2}
    study = pendulum(
        *QUICK,
        "+identification.motors.tau1={offset: 0.2, lag: 0.02, velocity: vel1, load: 0.3}",
        "+identification.motors.tau2={gain: 0.3, delay: 0.01, velocity: vel2, stribeck: 0.3}",
        "+identification.sensors={pos1: {offset: 0.1}}",
    )
    rig, rng = study.identification.prior(study.nominal), np.random.default_rng(2)  # type: ignore[attr-defined]
    robot = at(rig, friction_1=0.1, friction_2=0.1, damping_1=0.01, damping_2=0.01, **true)
    fitted = study.identification.fit(study.nominal, [recorded(robot, rng)])
    assert isinstance(fitted, Identified)
    found = {estimate.name: estimate for estimate in fitted.estimates}
    for name, value in true.items():
        width = found[name].high - found[name].low
        assert abs(found[name].value - value) < 1.5 * width
        assert abs(found[name].value - value) < 0.25 * value
    assert set(found) == {parameter.name for parameter in rig.parameters}


def test_a_mujoco_model_has_motors_too(tmp_path: Path) -> None:
    task = cart_pole()
    model = Mujoco(task, mjcf(tmp_path), uncertainty={"pole.mass": 0.2})
    rig = Rig(task, model, {"force": Motor(gain=0.2, delay=0.02)}, {"angle": Sensor(offset=0.1)})
    half = at(rig, **{"force.gain": 0.5})
    x, u = np.array([[0.1, 0.05, 0.3, 0.4]]), np.array([[4.0]])
    np.testing.assert_allclose(half.step(x, u), model.step(x, 0.5 * u), rtol=1e-9)
    rng = np.random.default_rng(0)
    rollout = Rollout(0.1 * rng.standard_normal((31, 4)), rng.standard_normal((30, 1)))
    windows = Windows.of([rollout], 10, 5)
    with interpreted():
        made = predict([PredictionModel(half)], windows)
    np.testing.assert_allclose(made, plain([PredictionModel(half)], windows), rtol=1e-8)


def test_a_zero_is_of_one_recording(study: Study) -> None:
    """Of other recordings the prior alone knows it; what was learned of all else stays."""
    rig = Rig(study.task, study.nominal, {}, {"pos2": Sensor(zero=0.05)})
    rng, p = np.random.default_rng(0), len(rig.parameters)
    here = Identified(rig, np.append(np.zeros(p - 1), 2.0), 0.1 * rng.standard_normal((p, p)), {})
    assert here.estimates[-1].value == pytest.approx(0.1)
    other = here.elsewhere()
    assert other.estimates[-1].value == 0.0
    np.testing.assert_allclose(other.covariance[-1], np.eye(p)[-1], atol=1e-15)
    np.testing.assert_allclose(other.covariance[:-1, :-1], here.covariance[:-1, :-1])
    true = study.nominal.with_parameters(values_at(study.nominal.parameters, np.zeros(p - 1)))
    x, u, zero = rng.standard_normal((20, 4)), rng.standard_normal((20, 2)), np.array([0.0, 0.1, 0.0, 0.0])
    np.testing.assert_allclose(other.step(x, u), true.step(x, u), rtol=1e-12)
    np.testing.assert_allclose(here.step(x + zero, u), true.step(x, u) + zero, rtol=1e-9)
    assert np.std([other.draw(rng).step(x[:1], u[:1])[0, 1] for _ in range(99)]) > 0.0


def test_a_motors_zero_is_an_offset_of_one_recording(study: Study) -> None:
    """It acts as an offset; how recordings differ is told by zeros as declared, and a little by all else."""
    rig = Rig(study.task, study.nominal, {"tau1": Motor(offset=0.2, zero=0.1)}, {})
    rng, p = np.random.default_rng(0), len(rig.parameters)
    x, u = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    by_zero, by_offset = at(rig, **{"tau1.zero": 0.05}), at(rig, **{"tau1.offset": 0.05})
    np.testing.assert_array_equal(by_zero.step(x, u), by_offset.step(x, u))
    assert [each.name for each in rig.parameters if each.of_recording] == ["tau1.zero"]
    shift = Identified(rig, rng.standard_normal(p), 0.1 * np.eye(p), {}).of_shift()
    names = [each.name for each in rig.parameters]
    deviations = dict(zip(names, np.sqrt(np.diag(shift.covariance)), strict=True))
    assert deviations.pop("tau1.zero") == 1.0
    assert set(deviations.values()) == {SHIFT}


@pytest.mark.slow
def test_a_load_is_of_one_recording_and_all_else_is_shared() -> None:
    """Put on in the second of two recordings, it comes back there, beside what both share."""
    study = pendulum(
        *("identification=posterior", "identification.starts=4", "identification.rounds=2"),
        "identification.each=[damping_2]",
    )
    rig, rng = study.identification.prior(study.nominal), np.random.default_rng(0)  # type: ignore[attr-defined]
    loads = (0.002, 0.04)
    robots = [at(rig, friction_1=0.1, friction_2=0.1, damping_2=load) for load in loads]
    fitted = study.identification.fit(study.nominal, [recorded(robot, rng) for robot in robots])
    assert isinstance(fitted, Identified)
    for i, load in enumerate(loads):
        found = {estimate.name: estimate.value for estimate in fitted.of_recording(i).estimates}
        assert found["damping_2"] == pytest.approx(load, abs=0.01)
        assert found["friction_1"] == pytest.approx(0.1, abs=0.02)


@pytest.mark.slow
def test_recordings_that_are_fitted_together_have_their_own_zeros() -> None:
    """Each zero comes back; of yet another recording the prior alone is known."""
    study = pendulum(
        *QUICK,
        "+identification.sensors={pos2: {zero: 0.05}}",
    )
    rig, rng = study.identification.prior(study.nominal), np.random.default_rng(1)  # type: ignore[attr-defined]
    zeros = (0.08, -0.05, 0.0)
    robots = [at(rig, friction_1=0.1, friction_2=0.1, **{"pos2.zero": zero}) for zero in zeros]
    fitted = study.identification.fit(study.nominal, [recorded(robot, rng) for robot in robots])
    assert isinstance(fitted, Identified)
    for i, zero in enumerate(zeros):
        found = fitted.of_recording(i).estimates[-1]
        assert found.value == pytest.approx(zero, abs=0.02)
        assert found.low < found.value < found.high < found.low + 0.03
    assert fitted.estimates[-1].value == 0.0
    assert not any("pos2.zero" in direction.weights for direction in undetermined(fitted))
    assert [p.of_recording for p in KnownPrior(rig, fitted.known).parameters] == [False] * 11 + [True]


def test_what_the_task_has_not_is_told(study: Study) -> None:
    for motors, sensors, words in (
        ({"tau3": Motor(0.1)}, {}, "identification.motors: no tau3; there is tau1, tau2"),
        ({}, {"angle": Sensor(0.1)}, "identification.sensors: no angle; there is pos1"),
        ({"tau1": Motor(load=0.1)}, {}, "identification.motors.tau1.velocity: missing"),
        ({"tau1": Motor(load=0.1, velocity="v")}, {}, "identification.motors: no v; there is pos1"),
        ({"tau1": Motor(delay=1.0)}, {}, "a delay of up to 4 s is 2000 frames"),
    ):
        with pytest.raises(ValueError, match=words):
            Rig(study.task, study.nominal, motors, sensors)
    with pytest.raises(ValueError, match=r"identification\.each: no load; there is mass_1, "):
        Rig(study.task, study.nominal, {}, {}, each=["load"])
