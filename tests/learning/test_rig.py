"""Motors and sensors whose parameters are known, identified with a robot's own."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from interpreted import predicted_as_plain
from mechanisms import cart_pole, mjcf
from models import driven, with_values
from pendulum import NOISE, QUICK, pendulum

import simbias
from simbias.core import Nominal, StudyWarning
from simbias.core.errors import ConfigError
from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified, KnownPrior
from simbias.learning.identification.posterior import Posterior
from simbias.learning.identification.problem import WindowErrors
from simbias.learning.identification.rig import Motor, Rig, Sensor
from simbias.learning.prediction_errors import ErrorDistribution
from simbias.recordings.findings import findings
from simbias.robots.mujoco.model import Mujoco
from simbias.simulation.open_loop import PredictionModel, Windows
from simbias.trial.study import Study

MOTOR = Motor(0.2, 0.1, 0.02, 0.01, "vel1", 0.3, 0.2)
SENSORS = {"pos1": Sensor(0.05, 0.1), "vel2": Sensor(0.1)}


@pytest.fixture(scope="module")
def study() -> Study:
    return pendulum("identification=posterior")


def recorded(rig: Nominal, rng: np.random.Generator, frames: int = 1000, noise: Array = NOISE) -> Rollout:
    """A rig under smooth random torques."""
    t = 0.002 * np.arange(frames)[:, None]
    u = np.sum([0.7 * np.sin(rng.uniform(2, 20, 2) * t + rng.uniform(0, 6, 2)) for _ in range(4)], axis=0)
    return Rollout(driven(rig, np.zeros(4), u) + noise * rng.standard_normal((frames + 1, 4)), u)


def test_a_rig_is_the_model_behind_motors_and_sensors_and_its_kernel_the_plain_one(study: Study) -> None:
    """With all that a rig may have, and with sensors alone; an ideal one is the model."""
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    ideal = Rig(study.task, study.nominal, {"tau1": MOTOR}, SENSORS)
    np.testing.assert_allclose(ideal.step(x, u), study.nominal.step(x, u), rtol=1e-12)
    whole = with_values(
        ideal,
        **{"tau1.gain": 0.8, "tau1.offset": 0.05, "tau1.lag": 0.01, "tau1.delay": 0.005},
        **{"tau1.stribeck": 0.1, "tau1.load": 0.2, "pos1.offset": 0.05, "vel2.gain": 1.1},
    )
    seen = with_values(Rig(study.task, study.nominal, {}, SENSORS), **{"pos1.offset": 0.1, "vel2.gain": 1.2})
    gain, offset = [1, 1, 1, 1.2], [0.1, 0, 0, 0]
    there = study.nominal.step(x, u) * gain + offset
    np.testing.assert_allclose(seen.step(x * gain + offset, u), there, rtol=1e-9)
    for rig in (whole, seen):
        windows = Windows.of([recorded(rig, rng, 100)], 50, 5)
        predicted_as_plain([PredictionModel(rig)], windows, 1e-8, 1e-10)


def test_friction_brakes_and_falls_with_the_velocity(study: Study) -> None:
    """Never an acceleration along the velocity; Stribeck's half gone at its velocity."""
    motors = {"tau1": Motor(velocity="vel1", stribeck=1.0, load=1.0)}
    rig = Rig(study.task, study.nominal, motors, {})
    x, u = np.array([0.0, 0.0, 0.2, 0.0]), np.array([0.5, 0.0])
    changes = [
        (with_values(rig, **{name: value}).step(x, u) - study.nominal.step(x, u))[2]
        for name, value in (("tau1.stribeck", 0.1), ("tau1.stribeck", 0.2), ("tau1.load", 0.1))
    ]
    assert changes[0] < 0
    assert changes[1] == pytest.approx(2 * changes[0], rel=1e-3)
    assert changes[2] == pytest.approx(changes[0], rel=1e-3)  # half of 0.1 N m, and a tenth of 0.5 N m
    fitted = Identified(rig, np.zeros(len(rig.parameters)), 0.1 * np.eye(len(rig.parameters)), {})
    doubts = {each.prior.name: each.doubts for each in findings(fitted, [], [])}
    assumed = ("at the assumed Stribeck velocity of 0.2 rad/s",)
    assert doubts["tau1.stribeck"] == doubts["tau1.load"] == assumed != doubts["mass_1"]


def test_a_mujoco_model_has_motors_too(tmp_path: Path) -> None:
    task = cart_pole()
    model = Mujoco(task, mjcf(tmp_path), uncertainty={"pole.mass": 0.2})
    rig = Rig(task, model, {"force": Motor(gain=0.2, delay=0.02)}, {"angle": Sensor(offset=0.1)})
    half = with_values(rig, **{"force.gain": 0.5})
    x, u = np.array([[0.1, 0.05, 0.3, 0.4]]), np.array([[20.0]])
    np.testing.assert_allclose(half.step(x, u), model.step(x, 0.5 * u), rtol=1e-9)
    free = Mujoco(task, mjcf(tmp_path, actuators='<motor name="push" joint="slider"/>'))
    strong = with_values(rig, **{"force.gain": 1.5})  # it acts beyond the limit of what is commanded
    np.testing.assert_allclose(strong.step(x, u), free.step(x, 1.5 * u), rtol=1e-9)
    assert strong.step(x, u)[0, 2] > model.step(x, u)[0, 2] + 0.05
    rng = np.random.default_rng(0)
    rollout = Rollout(0.1 * rng.standard_normal((31, 4)), rng.uniform(-20, 20, (30, 1)))
    predicted_as_plain([PredictionModel(half), PredictionModel(strong)], Windows.of([rollout], 10, 5), 1e-8)


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
    """It acts as an offset."""
    rig = Rig(study.task, study.nominal, {"tau1": Motor(offset=0.2, zero=0.1)}, {})
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal((20, 4)), rng.standard_normal((20, 2))
    by_zero, by_offset = with_values(rig, **{"tau1.zero": 0.05}), with_values(rig, **{"tau1.offset": 0.05})
    np.testing.assert_array_equal(by_zero.step(x, u), by_offset.step(x, u))
    assert [each.name for each in rig.parameters if each.of_recording] == ["tau1.zero"]


def test_pieces_of_a_recording_share_its_own(study: Study) -> None:
    posterior = Posterior(study.task, sensors={"pos2": Sensor(zero=0.05)})
    rig, rollout = posterior.prior(study.nominal), Rollout(np.zeros((101, 4)), np.zeros((100, 2)))
    windows = posterior.windows(3 * [rollout], ["one", "other", "one"])
    comparison, p = WindowErrors(rig, windows), len(rig.parameters)
    np.testing.assert_array_equal(comparison.places[:, -1], [p - 1, p, p - 1])
    z = np.append(np.zeros(p - 1), [1.0, 2.0])
    fitted = Identified.of_recordings(
        rig, z, np.eye(p + 1), comparison.places, ErrorDistribution(np.empty((0, 0)))
    )
    assert [each.mode[-1] for each in fitted.recordings] == [1.0, 2.0]


SHARED = {"tau1.offset": 0.15, "tau1.lag": 0.015, "tau1.load": 0.25, "pos1.offset": 0.08}
SHARED |= {"tau2.gain": 0.75, "tau2.delay": 0.006, "tau2.stribeck": 0.2}
ZEROS, LOADS = (0.08, -0.05), (0.002, 0.04)  # of each recording


@pytest.fixture(scope="module")
def fitted() -> Identified:
    """A rig with all that it may have, beside the pendulum's parameters, from two recordings."""
    study = pendulum(
        *QUICK,
        "+identification.motors.tau1={offset: 0.2, lag: 0.02, velocity: vel1, load: 0.3}",
        "+identification.motors.tau2={gain: 0.3, delay: 0.01, velocity: vel2, stribeck: 0.3}",
        "+identification.sensors={pos1: {offset: 0.1}, pos2: {zero: 0.05}}",
        "identification.each=[damping_2]",
    )
    rig, rng = study.identification.prior(study.nominal), np.random.default_rng(3)  # type: ignore[attr-defined]
    # Few windows are slow enough for Stribeck friction: of seeds 2 to 9, one errs by eight told deviations.
    joints = {"friction_1": 0.1, "friction_2": 0.1, "damping_1": 0.01}
    own = [{"pos2.zero": zero, "damping_2": load} for zero, load in zip(ZEROS, LOADS, strict=True)]
    records = [recorded(with_values(rig, **joints, **SHARED, **each), rng) for each in own]
    found = study.identification.fit(study.nominal, records)
    assert {each.name for each in found.estimates} == {each.name for each in rig.parameters}
    return found  # type: ignore[return-value]


@pytest.mark.slow
def test_a_load_is_of_one_recording_and_all_else_is_shared(fitted: Identified) -> None:
    """Put on in the second of two recordings, it comes back there, and so does what both share."""
    for i, load in enumerate(LOADS):
        found = {estimate.name: estimate for estimate in fitted.of_recording(i).estimates}
        assert found["damping_2"].value == pytest.approx(load, abs=0.01)
        assert found["friction_1"].value == pytest.approx(0.1, abs=0.02)
        for name, value in SHARED.items():
            width = found[name].high - found[name].low
            assert abs(found[name].value - value) < min(1.5 * width, 0.35 * value), name


@pytest.mark.slow
def test_recordings_that_are_fitted_together_have_their_own_zeros(fitted: Identified) -> None:
    """Each zero comes back; of yet another recording the prior alone is known."""
    for i, zero in enumerate(ZEROS):
        found = {estimate.name: estimate for estimate in fitted.of_recording(i).estimates}["pos2.zero"]
        assert found.value == pytest.approx(zero, abs=0.02)
        assert found.low < found.value < found.high < found.low + 0.03
    elsewhere = {estimate.name: estimate.value for estimate in fitted.estimates}
    assert elsewhere["pos2.zero"] == 0.0
    assert not any("pos2.zero" in direction.weights for direction in undetermined(fitted))
    prior = KnownPrior(fitted.model, fitted.known).parameters
    assert {each.name for each in prior if each.of_recording} == {"pos2.zero", "damping_2"}


def test_a_known_posterior_has_a_number_for_each_parameter(study: Study) -> None:
    known = Identified.of_prior(study.nominal).known
    for wrong in (replace(known, mode=known.mode[:1]), replace(known, spread=known.spread[:1])):
        with pytest.raises(ConfigError, match=r"known: mode and spread must be for 11 parameters"):
            KnownPrior(study.nominal, wrong)


def test_what_the_task_has_not_is_told(study: Study) -> None:
    for motors, sensors, words in (
        ({"tau3": Motor(0.1)}, {}, "motors: no tau3; available: tau1, tau2"),
        ({}, {"angle": Sensor(0.1)}, "sensors: no angle; available: pos1"),
        ({"tau1": Motor(load=0.1)}, {}, "motors.tau1.velocity: missing"),
        ({"tau1": Motor(load=0.1, velocity="v")}, {}, "motors: no v; available: pos1"),
        ({"tau1": Motor(delay=1.0)}, {}, "a delay of up to 4 s is 2000 frames"),
    ):
        with pytest.raises(ValueError, match=words):
            Posterior(study.task, motors=motors, sensors=sensors)
    with pytest.raises(ConfigError, match=r"^identification: motors: no force; available: tau1, tau2$"):
        simbias.load(["preset=double_pendulum", "identification=cartpole_swingup"])
    with pytest.raises(ValueError, match=r"identification\.each: no load; available: mass_1, "):
        Rig(study.task, study.nominal, {}, {}, each=["load"])
    known = asdict(Identified.of_prior(study.nominal).known)
    known["doubts"] = [["recordings disagree"]] * len(known["mode"])
    keys_in_plain = re.sub(r'"(\w+)": ', r"\1: ", json.dumps(known))
    with pytest.warns(StudyWarning, match="begins with a posterior of which no parameter is trusted"):
        pendulum("identification=posterior", f"identification.known={keys_in_plain}")
    with pytest.raises(ValueError, match=r"pos1\.gain is uncertain in nominal\.uncertainty, too"):
        Rig(study.task, Rig(study.task, study.nominal, {}, SENSORS), {}, {"pos1": Sensor(0.1)})
