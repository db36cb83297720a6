"""Safety at the boundary: limits abort an experiment, what is predicted is shown, and a person is asked."""

import io
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from labs import THETA
from point_mass import InTheWind
from records import assert_equal
from rich.console import Console

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.core import HardwareError, Policy
from simbias.core.commands import SUCCEEDED, WAITING
from simbias.core.records import Array, Rollout
from simbias.lab.checked_hardware import ExperimentConditions
from simbias.lab.safety import Safety, SafetyLimitedPolicy, UnsafeError
from simbias.pictures.preview import preview
from simbias.terminal.preview import describe, first_prediction
from simbias.terminal.trial import TrialConsole
from simbias.trial import prediction
from simbias.trial.diagnostics import of_safety
from simbias.trial.folder import EXPERIMENT, OUTCOME, TrialFolder
from simbias.trial.methods.ideal import Ideal
from simbias.trial.observer import Observer
from simbias.trial.prediction import DRAWS, predict
from simbias.trial.run import run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

START = np.array([0.5, 0.0])


class Stoppable(InTheWind):
    """Counts how often it is stopped, and may do something in between."""

    stopped = 0

    def stop(self) -> None:
        self.stopped += 1


class Swallowing(Stoppable):
    """Makes something else of what the controller raises."""

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        try:
            return super().run(policy, theta, start, rng)
        except Exception as error:
            raise OSError("bus off") from error


class EnoughError(Exception):
    """Ends a trial after its first experiment."""


def first_experiment(study: Study) -> Rollout:
    """That of a trial."""
    made, observer = list[Rollout](), Observer()

    def end(rollout: Rollout) -> None:
        made.append(rollout)
        raise EnoughError

    observer.experimented = end  # type: ignore[method-assign]
    with pytest.raises(EnoughError):
        next(study.run(observer))
    return made[0]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two draws of a prediction are enough where no share of them is asked for."""
    monkeypatch.setattr(prediction, "DRAWS", 2)


def test_an_instance_may_say_that_it_is_concurrent(point_mass: Study) -> None:
    """Though its class has a stop()."""
    robot = Stoppable(point_mass.task)  # type: ignore[arg-type]
    assert not robot.concurrent
    robot.concurrent = True
    assert robot.concurrent


def experiment(study: Study, safety: Safety, hardware: type = Stoppable) -> tuple[Rollout, int]:
    """An experiment under limits, and how often the hardware was stopped."""
    robot = hardware(study.task)
    limited = replace(study, hardware=robot, conditions=ExperimentConditions(safety=safety))
    return limited.experiment(THETA, np.random.default_rng(0), START), robot.stopped


def test_an_experiment_beyond_a_limit_is_aborted(point_mass: Study) -> None:
    """It has failed, the hardware is stopped, and what was recorded is what the free one did up to there."""
    free, _ = experiment(point_mass, Safety())
    speeds, forces = np.abs(free.states[:, 1]), np.abs(free.inputs[:, 0])
    fast = np.abs(np.diff(free.inputs[:, 0])) > 5.0 * 0.02
    limits = (
        (Safety(states={"velocity": 0.3}), "unsafe_state_velocity", np.argmax(speeds > 0.3)),
        (Safety(inputs={"force": 3.9}), "unsafe_input_force", np.argmax(forces > 3.9)),
        (Safety(input_rates={"force": 5.0}), "unsafe_rate_of_force", 1 + np.argmax(fast)),
    )
    for hardware, (safety, failure, first) in product((Stoppable, Swallowing), limits):
        aborted, stopped = experiment(point_mass, safety, hardware)
        k = aborted.frames
        assert (aborted.failed_at, aborted.failure, stopped, k) == (k, failure, 1, first)
        assert aborted.cost > point_mass.cost.max_cost
        np.testing.assert_array_equal(aborted.states, free.states[: k + 1])
        np.testing.assert_array_equal(aborted.inputs, free.inputs[:k])


def test_a_sensor_that_tells_no_number_aborts_without_a_limit_too(point_mass: Study) -> None:
    """As the controllers in C and in Python do."""
    bounds = Safety(inputs={"force": 3.9}).bounds(point_mass.task)
    for broken in (np.inf, -np.inf, np.nan):
        controller = SafetyLimitedPolicy(point_mass.policy, point_mass.task, bounds).controller(THETA, 0.02)
        with pytest.raises(UnsafeError, match="unsafe_state_velocity"):
            controller(np.array([0.0, broken]))


def test_a_hardware_that_does_not_ask_the_controller_is_held_against_the_limits(point_mass: Study) -> None:
    """A state beyond them ends the rollout, as if it had been aborted; an input beyond them is refused."""

    class Own(Stoppable):
        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
            return super().run(point_mass.policy, theta, start, rng)

    free, _ = experiment(point_mass, Safety())
    aborted, _ = experiment(point_mass, Safety(states={"velocity": 0.3}), Own)
    k = aborted.frames
    failed = {"failed_at": k, "failure": "unsafe_state_velocity", "cost": aborted.cost}
    assert_equal(aborted, replace(free, states=free.states[: k + 1], inputs=free.inputs[:k], **failed))
    assert np.abs(aborted.states[-1, 1]) > 0.3 >= np.abs(aborted.states[:-1, 1]).max()
    for safety in (Safety(inputs={"force": 3.9}), Safety(input_rates={"force": 5.0})):
        with pytest.raises(HardwareError, match=r"^Own\.run: inputs: .* hardware\.safety, got "):
            experiment(point_mass, safety, Own)


def test_limits_that_nothing_exceeds_change_nothing(point_mass: Study) -> None:
    limits = Safety(
        inputs={"force": 5.0}, input_rates={"force": 1e4}, states={"position": 2.0}, criteria=True
    )
    assert_equal(experiment(point_mass, limits)[0], experiment(point_mass, Safety())[0])


def test_a_measured_state_that_violates_a_criterion_aborts(point_mass: Study) -> None:
    """The hardware itself sees no failure."""

    class Blind(Stoppable):
        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
            controller, states, inputs = policy.controller(theta, 0.02), [start], []
            for _ in range(100):
                inputs.append(controller(states[-1]))
                states.append(states[-1] + [0.02, 0.0])
            return Rollout(np.array(states), np.array(inputs))

    aborted, stopped = experiment(point_mass, Safety(criteria=True), Blind)
    assert (aborted.failure, stopped) == ("distance", 1)
    assert abs(aborted.states[-1, 0]) > 1.0 >= abs(aborted.states[-2, 0])
    whole, stopped = experiment(point_mass, Safety(), Blind)
    assert (whole.failed_at, whole.failure, stopped) == (aborted.failed_at, "distance", 0)  # it ran on


@pytest.mark.slow
def test_a_limit_of_nothing_is_bad_input() -> None:
    for override, key in {
        "hardware.safety.inputs={torque: -1}": "hardware.safety.inputs.torque",
        "hardware.safety.input_rates={angle: 1}": "hardware.safety",
        "+hardware.safety.limits=3": "hardware.safety.limits",
    }.items():
        with pytest.raises(ConfigError, match=rf"^{re.escape(key)}: "):
            simbias.load([override, "tracking=none"])
    with pytest.raises(
        ConfigError, match=r"^hardware\.safety: states: nothing is called bearing; available: "
    ):
        simbias.load(["preset=reacher", "+hardware.safety.states.bearing=1", "tracking=none"])


@pytest.mark.slow
def test_a_limit_of_a_kind_is_none_of_targets() -> None:
    targets = "+task.targets.bearing={kind: angle, uniform: [2.9, 3.1]}"
    limit = "+hardware.safety.states.angle=2.95"
    study = simbias.load(["preset=reacher", targets, limit, "tracking=none"])
    limits = study.conditions.safety.bounds(study.task).states
    np.testing.assert_array_equal(limits, [2.95, 2.95] + [np.inf] * 4)


def test_limits_are_part_of_a_trials_identity_and_the_question_is_not() -> None:
    def loaded(*overrides: str) -> Study:
        return simbias.load([*overrides, "tracking=none"])

    base = loaded().hash
    assert loaded("hardware.confirm=true", "hardware.safety.states={}").hash == base
    assert loaded("hardware.safety.criteria=true").hash != base
    limited = loaded("hardware.safety.states={angle: 0.5, theta: 0.3}")  # by kind, and its own
    assert limited.hash != base
    bounds = limited.conditions.safety.bounds(limited.task)
    np.testing.assert_array_equal(bounds.states, [0.5, 0.5, 0.3, np.inf, np.inf, np.inf])
    np.testing.assert_array_equal(bounds.inputs, [100.0])


def test_the_band_holds_what_is_expected(point_mass: Study) -> None:
    """Draws differ in their starts, which are normal: nine tenths of these are in the band."""
    prediction = predict(point_mass, THETA, point_mass.task.start_mean)
    low, high = prediction.band()
    assert low.shape == (101, 2)
    assert (low <= prediction.expected.states).all()
    assert (prediction.expected.states <= high).all()
    width = (high - low)[0] / (2 * 1.645 * point_mass.task.start_deviation)
    assert (width > 0.6).all()
    assert (width < 1.4).all()
    again = predict(point_mass, THETA, point_mass.task.start_mean)
    assert_equal(again.draws[-1], prediction.draws[-1])
    assert len(prediction.draws) == DRAWS
    assert prediction.failures == []
    inputs = np.concatenate([np.diff(draw.inputs, axis=0) for draw in prediction.draws])
    assert prediction.largest_change(0.02) == pytest.approx(np.abs(inputs).max() / 0.02, rel=0.2)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "few")
def test_draws_have_the_pushes_of_the_task_and_the_noise_of_the_hardware() -> None:
    """What is expected has neither, and starts and models are the same."""
    quiet = [f"hardware.noise.{kind}_variance=0" for kind in ("position", "angle", "velocity")]
    short, told = ["preset=cartpole_swingup", "task.horizon=50", "task.hold=0.2", "tracking=none"], []
    for pushes, noise in product(([], ["task.pushes=null"]), ([], quiet)):
        study = simbias.load([*short, *pushes, *noise])
        theta = np.full(study.policy.n_parameters, 0.1)
        told.append(predict(study, theta, study.task.start_mean))
    assert [each.drawn for each in told] == [
        "start, model, noise and pushes",
        "start, model and pushes",
        "start, model and noise",
        "start and model",
    ]
    for each in told[:3]:
        np.testing.assert_array_equal(each.expected.inputs, told[3].expected.inputs)
        np.testing.assert_array_equal(each.draws[-1].states[0], told[3].draws[-1].states[0])
        assert np.abs(each.draws[-1].states[-1] - told[3].draws[-1].states[-1]).max() > 1e-3


def command(*overrides: str) -> list[str]:
    quick = ["tracking=none", "optimizer.max_evaluations=150"]
    return ["--config-dir", str(OWN_CONF), "--allow", "point_mass", *POINT_MASS, *quick, *overrides]


@pytest.mark.parametrize("noise", [{"angle_variance": "abc"}, {"torque_variance": -1.0}, {"moon": 1.0}, 0.5])
def test_what_is_no_noise_of_the_tasks_is_none(noise: object, point_mass: Study) -> None:
    composition = replace(point_mass.composition, config={"hardware": {"noise": noise}})  # type: ignore[type-var]
    assert replace(point_mass, composition=composition).declared_noise.is_silent


@pytest.mark.slow
def test_preview_shows_and_draws_the_first_experiment(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(InTheWind, "run", None)  # none is made
    assert main(["preview", *command("hardware.safety.states={velocity: 0.3}")]) == SUCCEEDED
    out = capsys.readouterr().out
    assert "velocity" in out
    assert " 0.3  m/s" in out
    assert re.search(r"hardware\.safety aborts it after 0\.\d\d s: \|velocity\| of 0\.3", out)
    assert f"Of {DRAWS} draws of start and model, 0 succeed, {DRAWS} are aborted by hardware.safety, 0" in out
    assert [path.name for path in folder.iterdir()] == ["preview.png"]


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "few")
def test_a_policy_beyond_safety_limits_in_simulation_is_told_and_no_success(point_mass: Study) -> None:
    """Searches do not know them."""
    safety = Safety(states={"velocity": 0.1}, input_rates={"force": 1e-3})
    study = replace(point_mass, conditions=ExperimentConditions(safety=safety))
    (remark,) = of_safety(THETA, START, model := study.first_model(), study)
    assert not [*of_safety(THETA, -START, model, study)]  # from another start it is within
    assert re.search(r"\|velocity\| of 0\.\d+ m/s \(limit 0\.1\), a change of force by", remark.words)
    console = TrialConsole(study, Console(file=(file := io.StringIO()), width=200))
    for _ in range(2):
        console.designed(THETA, model)
        for start in (START, -START, START):  # once of each policy, though it fails from two starts
            console.experimenting(THETA, start)
    assert file.getvalue().count("goes beyond hardware.safety in simulation") == 2
    prediction, bounds = predict(study, THETA, START), safety.bounds(study.task)
    diverging = tuple(replace(each, states=1e3 * each.states) for each in prediction.draws)
    axes, *_ = preview(study, replace(prediction, draws=diverging), bounds).axes
    assert np.ptp(axes.get_ylim()) < 12 * np.ptp(prediction.expected.states[:, 0])  # the band leaves them
    failing = [
        replace(each, failed_at=each.frames, failure="distance")
        for each in (prediction.expected, *prediction.draws)
    ]
    for each in (prediction, replace(prediction, expected=failing[0], draws=tuple(failing[1:]))):
        told = "\n".join(describe(study, each, bounds))  # before it fails
        assert "Predicted: hardware.safety aborts it after 0.02 s: a change of force by" in told
        assert "cost" not in told
        assert "then fails" not in told
        assert "ABORTS" not in told
        assert "0 succeed, 2 are aborted by hardware.safety, 0 fail." in told


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "few")
@pytest.mark.parametrize("preset", ["[pendulum_swingup,scratch]", "reacher"])
def test_a_preview_is_of_the_first_experiment_whatever_its_policy(preset: str) -> None:
    """A network's, or one that plays random inputs before there is one; with targets that a start has.

    Or what a search on the simulated hardware finds.
    """
    quick = ["evaluation.rollouts=1", "optimizer.explorations=4", "optimizer.max_evaluations=8"]
    study = simbias.load([f"preset={preset}", "tracking=none", "task.horizon=20", "task.hold=0.1", *quick])
    prediction, made = first_prediction(study), first_experiment(study)
    np.testing.assert_allclose(prediction.expected.states[0], made.states[0])
    np.testing.assert_allclose(prediction.expected.inputs[0], made.inputs[0], atol=0.5)  # N m; it is noisy
    assert len(prediction.draws) == 2
    told = "\n".join(describe(study, prediction, study.conditions.safety.bounds(study.task)))
    blind = "scratch" in preset  # the inputs are known, without a model nothing else is
    assert ("There is no model, so the first experiment's states" in told) == blind
    assert ("Predicted: " not in told and study.task.states[0].name not in told) == blind
    ideal = replace(study, method=Ideal(rollouts=1))
    expected = first_prediction(ideal).expected.parameters
    np.testing.assert_array_equal(expected, first_experiment(ideal).parameters)


@pytest.mark.slow
def test_a_person_is_asked_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], point_mass: Study
) -> None:
    answers: tuple[tuple[Any, int], ...] = (("y", SUCCEEDED), ("no", WAITING), (EOFError(), WAITING))
    for answer, status in answers:
        asked: list[str] = []

        def reply(question: str, answer: Any = answer, asked: list[str] = asked) -> str:
            asked.append(question)
            if isinstance(answer, Exception):
                raise answer
            return str(answer)

        monkeypatch.setattr("builtins.input", reply)
        assert main(command("hardware.confirm=true")) == status
        assert len(asked) == 1
        captured = capsys.readouterr()
        assert "Predicted: 2.00 s, cost " in captured.out
        assert ("the experiment was not confirmed" in captured.err) == (status == WAITING)
    monkeypatch.setattr("builtins.input", lambda question: "y")
    task = point_mass.task
    assert TrialConsole(point_mass).ask(point_mass.policy, THETA, task.start_mean, task.frames(3.0))
    assert "Predicted: 3.00 s, cost " in capsys.readouterr().out


@pytest.mark.slow
def test_what_is_replayed_is_not_asked_for(point_mass: Study, tmp_path: Path) -> None:
    starts: list[Array] = []

    def allow_first(policy: Policy, theta: Array, start: Array, horizon: int) -> bool:
        starts.append(start)
        return len(starts) == 1

    whole, folder = run_trial(point_mass, tmp_path), TrialFolder(tmp_path)
    steps = folder.steps()
    last = max(index for index, step in enumerate(steps) if step.name.endswith(EXPERIMENT))
    for file in (*steps[last:], tmp_path / OUTCOME):
        file.unlink()  # it was killed in the last experiment
    asking = replace(point_mass, conditions=ExperimentConditions(confirm=True, ask=allow_first))
    assert run_trial(asking, tmp_path).outcome is Outcome.SUCCEEDED
    assert len(starts) == 1
    np.testing.assert_array_equal(starts[0], whole.iterations[-1].experiments[-1].states[0])
