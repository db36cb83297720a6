"""What is said before anything is recorded: excitation, and whether parameters come back."""

import re
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pendulum import NOISE, QUICK, experiment, pendulum, truth

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core.parameters import values_at
from simbias.core.records import Rollout
from simbias.learning.identification.identified import Identified, Known
from simbias.recordings.excitation import MODELS, Designer
from simbias.recordings.findings import findings
from simbias.recordings.recovery import Take, doubt, record, recover
from simbias.recordings.study import prepared
from simbias.simulation.open_loop import PredictionModel
from simbias.trial.study import Study

LAB = "excitation_143601.csv.gz"


def limited(*limits: str) -> Study:
    return pendulum(*QUICK, *limits)


@pytest.fixture(scope="module")
def lab() -> Rollout:
    """Two seconds of a lab's chirps on the double pendulum."""
    return pendulum().hardware.rollout(LAB)  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def study(lab: Rollout) -> Study:
    """The limits that the lab's robot kept: positions, speeds and torques."""
    states, inputs = np.abs(lab.states).max(axis=0), np.abs(lab.inputs).max(axis=0)
    names = ("pos1", "pos2", "vel1", "vel2")
    pairs = ", ".join(f"{name}: {most}" for name, most in zip(names, states, strict=True))
    return limited(
        f"hardware.safety.states={{{pairs}}}",
        f"hardware.safety.inputs={{tau1: {inputs[0]}, tau2: {inputs[1]}}}",
    )


@pytest.mark.slow
def test_the_limits_are_kept_on_every_draw(study: Study) -> None:
    """And more trajectories tell more."""
    designer = Designer(study, study.nominal, NOISE)
    few, found = (designer.design(1.0, count, np.random.default_rng(0)) for count in (3, 10))
    assert found.information >= few.information > 0
    bounds = study.conditions.safety.bounds(study.task)
    assert (np.abs(found.rollout.inputs) <= bounds.inputs).all()
    simulated = designer._simulated(found.rollout.inputs, designer._models)
    reached = [np.abs(each.states).max(axis=0) for each in simulated]
    assert len(reached) == MODELS
    assert (found.largest <= bounds.states).all()
    np.testing.assert_array_equal(found.largest, np.max(reached, axis=0))
    assert (found.deviations < 1).any()
    none, few, most = (designer.beyond(scale * found.rollout.inputs) for scale in (0.0, 1.0, 3.0))
    assert 0 == none <= few < 0.1 < most


@pytest.mark.slow
def test_a_recording_tells_as_much_as_is_expected() -> None:
    """In nats, that predictions which begin at smoothed states gain."""
    study = prepared(limited())
    designer = Designer(study, study.nominal, NOISE)
    found = designer.design(2.0, 1, np.random.default_rng(0))
    take, rng = Take(study.task.start_mean, found.rollout.inputs), np.random.default_rng(0)
    recording = record(study, PredictionModel(designer._models[0]), take, NOISE, rng)
    fit = study.identification.fit(study.nominal, [recording])
    assert isinstance(fit, Identified)
    gained = -np.linalg.slogdet(fit.covariance)[1] / 2
    assert found.information == pytest.approx(gained, rel=0.2)


@pytest.mark.slow
def test_noise_is_in_proportion_to_motion() -> None:
    """Of each state, in whichever unit and whether a limit is declared or not."""
    noises = []
    for limits in ([], ["hardware.safety.states={vel1: 1000}"]):
        both = limited(*limits)
        designer = Designer(both, both.nominal)
        noises.append(designer.noise)
        found = designer.rated(designer._inputs(designer._random(np.random.default_rng(1)), 1.0))
        assert found is not None
        shares = designer.noise / np.ptp(found.rollout.states, axis=0)
        assert ((shares > 0.001) & (shares < 0.05)).all()
    np.testing.assert_array_equal(*noises)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_predictions")
def test_rotors_are_asked_only_to_push(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 0 to 12 N, or to a limit of the lab; torques of either sign are as large as they may be."""
    monkeypatch.setattr("simbias.recordings.excitation.MODELS", 2)
    pushes = ["preset=quadrotor_square", "identification=posterior", "bias=none", "tracking=none"]
    for safety, most in ((), 12.0), (("hardware.safety.inputs={thrust: 9}",), 9.0):
        flying = simbias.load([*pushes, *safety])
        designer = Designer(flying, flying.nominal, np.full(6, 1e-3))
        c = np.random.default_rng(0).standard_normal((2, 2, 20))
        found = designer.rated(designer._inputs(c, 0.6))
        assert found is not None
        assert found.rollout.inputs.min() == 0
        assert 1 < found.rollout.inputs.max() <= most
    both = limited()
    turning = Designer(both, both.nominal, NOISE)._inputs(c, 1.0)
    np.testing.assert_allclose(np.abs(turning).max(axis=0), both.task.input_limit, rtol=1e-12)


@pytest.mark.slow
def test_nothing_is_promised_that_no_recording_tells(study: Study) -> None:
    """The second link's mass: not by a first recording, nor by a stronger one after it."""
    robot, _ = truth(study.nominal, np.random.default_rng(0))
    recording = experiment(robot, np.random.default_rng(0), 400, 1e-3 * NOISE)
    learned = prepared(limited()).identification.fit(study.nominal, [recording])
    designer = Designer(prepared(limited()), learned, NOISE)
    found = designer.rated(10 * np.sin(np.arange(500)[:, None] * np.array([0.03, 0.05])))
    assert found is not None
    mass = [parameter.name for parameter in designer.nominal.parameters].index("mass_2")
    assert found.deviations[mass] == pytest.approx(designer.before[mass], rel=0.05)
    assert found.information > 3


def test_inputs_are_designed_within_limits_that_there_are() -> None:
    """Of those that neither the task nor the lab limits, the first is named."""
    one = limited("hardware.safety.inputs={tau1: 3}")
    task = copy(one.task)
    task._input_bounds = -np.full(2, np.inf), np.full(2, np.inf)  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"^hardware\.safety\.inputs: tau2 has no limit; set one here$"):
        Designer(replace(one, task=task), one.nominal, NOISE)


@pytest.mark.slow
def test_what_is_designed_tells_more_than_a_labs_chirps(study: Study, lab: Rollout) -> None:
    """Within the limits that the lab kept, on the same models: posteriors of four robots are smaller, and
    nearer to the truth.
    """
    designer = Designer(study, study.nominal, NOISE)
    found = designer.design(2.0, 100, np.random.default_rng(0))
    chirps = designer.rated(lab.inputs)
    assert chirps is not None
    takes = [Take(study.task.start_mean, each.rollout.inputs) for each in (chirps, found)]
    rng, volumes, errors = np.random.default_rng(1), [], []
    for _ in range(4):
        z = rng.standard_normal(len(study.nominal.parameters))
        robot = study.nominal.with_parameters(values_at(study.nominal.parameters, z))
        fits = [
            study.identification.fit(study.nominal, [record(study, PredictionModel(robot), take, NOISE, rng)])
            for take in takes
        ]
        assert all(isinstance(fit, Identified) for fit in fits)
        volumes.append([np.linalg.slogdet(fit.covariance)[1] / 2 / len(z) for fit in fits])  # type: ignore[attr-defined]
        errors.append([np.sqrt(np.mean((fit.mode - z) ** 2)) for fit in fits])  # type: ignore[attr-defined]
    of_chirps, of_design = np.mean(volumes, axis=0)
    assert np.exp(of_design - of_chirps) < 0.85  # of the chirps' deviation, a geometric mean over parameters
    assert np.mean(errors, axis=0)[1] < np.mean(errors, axis=0)[0]


@pytest.mark.slow
def test_parameters_come_back_and_intervals_tell_the_truth(study: Study, lab: Rollout) -> None:
    found = recover(limited(), [Take(lab.states[0], lab.inputs)], NOISE, robots=3)
    by_name = {recovery.name: recovery for recovery in found}
    assert not by_name["friction_2"].doubt
    assert by_name["mass_1"].doubt in (
        "partly determined",
        "not determined by the data",
    )  # only its product is told
    assert np.mean([recovery.held for recovery in found]) > 0.7


def test_what_identify_would_not_trust_does_not_come_back() -> None:
    """As is told only together with another one, in half of the robots; nor if 7 of 10 intervals hold."""
    nominal = limited().nominal
    spread = 0.1 * np.eye(len(nominal.parameters))
    sure = findings(Identified(nominal, 0.0 * spread[0], spread, {}), [], [])[0]
    spread[1] = spread[0]
    tied = findings(Identified(nominal, 0.0 * spread[0], spread, {}), [], [])[0]
    assert sure.trusted
    assert doubt(5 * [sure] + 5 * [tied], 10) == f"only together with {nominal.parameters[1].name}"
    assert doubt(6 * [sure] + 4 * [tied], 8) == ""
    assert doubt(10 * [sure], 7) == "interval too narrow"


def test_robots_are_drawn_from_what_is_known() -> None:
    """Far from the prior, and next to each other; one that is not recorded for a window says nothing."""
    study = limited("nominal.uncertainty.bodies=false")
    names = [parameter.name for parameter in study.nominal.parameters]
    near = Known(names, [1.0] * len(names), (0.01 * np.eye(len(names))).tolist())
    known = replace(study, identification=study.identification.with_known(near))  # type: ignore[attr-defined]
    u = np.sin(np.arange(100)[:, None] * np.array([0.1, 0.2]))
    for recovery in recover(known, [Take(np.zeros(4), u)], NOISE, robots=1):
        assert recovery.error < 0.05, recovery.name
    with pytest.raises(ConfigError, match="no drawn robot lasts for a window"):
        recover(known, [Take(np.zeros(4), u[:20])], NOISE, robots=1)


def test_pieces_of_a_recording_have_the_same_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a robot at which no search for the mode begins."""
    study, made = limited("+identification.sensors={pos2: {zero: 0.1}}"), list[float]()

    def recorded(_: Study, model: PredictionModel, *others: object) -> Rollout:
        made.append(float(model.nominal.step(np.ones(4), np.zeros(2))[2]))
        return Rollout(np.zeros((1, 4)), np.zeros((0, 2)))

    monkeypatch.setattr("simbias.recordings.recovery.record", recorded)
    takes = [Take(np.zeros(4), np.zeros((9, 2)), recording=name) for name in ("one", "two", "one")]
    with pytest.raises(ConfigError, match="no drawn robot lasts"):
        recover(study, takes, NOISE, robots=1)
    assert made[0] == made[2] != made[1]
    rig = study.identification.prior(study.nominal)  # type: ignore[attr-defined]
    start = values_at(rig.parameters, np.random.default_rng(0).standard_normal(len(rig.parameters)))
    assert made[0] != rig.with_parameters(start).step(np.ones(4), np.zeros(2))[2]


def test_recordings_are_measured_when_the_lab_measures(study: Study) -> None:
    """Every fifth frame, with noise: between these times a recording is linear."""
    times = 0.01 * np.arange(101)
    take = Take(np.zeros(4), np.full((500, 2), 0.3), times)
    made = record(limited(), PredictionModel(study.nominal), take, NOISE, np.random.default_rng(0))
    assert made.frames == 500
    bends = np.abs(np.diff(made.states, 2, axis=0)).max(axis=1) > 1e-12
    assert set(np.flatnonzero(bends) % 5) == {4}


@pytest.mark.usefixtures("plain_predictions")
def test_a_late_motor_acts_at_once_only_where_a_recording_continues() -> None:
    study = limited("+identification.motors.tau1={delay: 0.02}")
    rig = study.identification.prior(study.nominal)  # type: ignore[attr-defined]
    values = [0.02 if each.name == "tau1.delay" else each.value for each in rig.parameters]
    model = PredictionModel(rig.with_parameters(np.array(values)))
    take, rng = Take(np.zeros(4), np.ones((20, 2)) * [1.0, 0.0]), np.random.default_rng(0)
    from_rest, on = (
        record(study, model, take._replace(continues=each), np.zeros(4), rng) for each in (False, True)
    )
    assert from_rest.states[5, 2] == 0.0 < on.states[5, 2]
    assert (from_rest.continues, on.continues) == (False, True)


def test_a_robot_that_fails_is_recorded_until_then(study: Study) -> None:
    wild = Take(np.array([0.0, 0.0, 59.0, 0.0]), np.full((500, 2), 10.0))
    made = record(limited(), PredictionModel(study.nominal), wild, np.zeros(4), np.random.default_rng(0))
    assert 0 < made.frames < 500
    assert (study.task.violated(made.states) < 0).all()
    gone = Take(np.array([0.0, 0.0, 70.0, 0.0]), np.zeros((100, 2)))
    late = wild._replace(times=np.array([0.5, 0.51]))
    for none in gone, late:
        with pytest.raises(ConfigError, match="no drawn robot lasts"):
            recover(limited(), [none], NOISE, robots=1)


def test_no_inputs_last_for_ever(capsys: pytest.CaptureFixture[str]) -> None:
    for seconds in ("1e5000", "nan", "-1", "0", "1e9"):
        assert main(["excite", f"--seconds={seconds}"]) == 2
        said = capsys.readouterr().err
        assert said.startswith("simbias: --seconds: must be from 0.01 to 3600, got ")
        assert said.count("\n") == 1


KNOWN = "identification.known={parameters: [moon], mode: [0], spread: [[1]]}"
REFUSED = [
    (["~moon"], "Could not delete from config. 'moon' does not exist"),  # no recording
    (["~/moon.csv"], "~/moon.csv: no such recording (.csv, "),
    (["identification.each=[moon]"], "identification.each: no moon; available: mass_1, "),
    ([KNOWN], "identification.known: is for moon; the nominal model's parameters are mass_1, "),
    (["--into=."], ".: cannot be written (it is a folder)\n"),
    (["--seconds=0.05"], "identification.window: 0.1 s is longer than inputs of 0.05 s\n"),
    (["--seconds=0.03"], "task.time_step: 0.002 s is too long for inputs of 0.03 s, which need at least 20 "),
    (["hardware.safety.states={vel1: 1e-6}"], "hardware.safety: no inputs were found that keep "),
    (["task.failure.speed.above=1e-6"], "task: no inputs were found that avoid its failures: "),
]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_a_bad_request_is_refused_in_one_line(
    words: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("simbias.terminal.excite.TRAJECTORIES", 1)
    options = ["preset=double_pendulum", "tracking=none"]
    assert main(["excite", *options, *words]) == 2
    assert capsys.readouterr().err.startswith(f"simbias: {said}")


@pytest.mark.slow
def test_the_commands(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("simbias.terminal.excite.TRAJECTORIES", 10)
    arguments = ["preset=double_pendulum", *QUICK[1:], "hardware.safety.states={vel1: 12, vel2: 15}"]
    assert main(["excite", *arguments, "--seconds", "1", "--into", "new/torques.csv"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^friction_2 +N m +1\.00  0\.\d\d$", out, re.MULTILINE)
    assert re.search(r"^This assumes an exact model and white noise of pos1 0\.0\d+ rad, ", out, re.MULTILINE)
    assert "The most probable model and 15 draws stay within |pos1| < " in out
    assert re.search(r"^Of 200 other draws, \d+% exceed the limits", out, re.MULTILINE)
    written = pd.read_csv(folder / "new" / "torques.csv")
    assert list(written) == ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]
    assert len(written) == 500
    assert main(["identify", "--recover", "new/torques.csv", *arguments]) == 0
    assert re.search(r"^friction_2 +N m .* yes$", capsys.readouterr().out, re.MULTILINE)
    assert main(["identify", *arguments]) == 2
    said = "simbias: identify: needs recordings neither held out nor learned: files or folders\n"
    assert capsys.readouterr().err == said
