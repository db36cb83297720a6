"""A person as the hardware: requests go out in folders, trajectories come back."""

import json
import shutil
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from labs import THETA, lines, requested, written
from point_mass import InTheWind, PointMass, Spring

from simbias.__main__ import main
from simbias.config import ConfigError, compose
from simbias.config.build import build
from simbias.core import HardwareError, Waiting
from simbias.core.commands import BAD_INPUT, SUCCEEDED, WAITING
from simbias.core.records import Array
from simbias.lab.checked_hardware import ExperimentConditions
from simbias.lab.requests import controller, verification
from simbias.lab.requests.folder import write_request
from simbias.lab.requests.manual import Manual
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.requests.trajectory import header, read
from simbias.lab.safety import Safety
from simbias.policy.output_feedback import OutputFeedback
from simbias.trial.folder import withdraw
from simbias.trial.run import run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

OWN = [*(each for each in POINT_MASS if "hardware" not in each), "optimizer.max_evaluations=20"]


@pytest.fixture(autouse=True)
def _few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Code is held against the policy in Python and for a few frames; `test_controllers.py` does it all."""
    monkeypatch.setattr(verification, "FRAMES", 10)
    monkeypatch.setattr(shutil, "which", lambda _: None)


def answer(folder: Path) -> None:
    """Do what a request says, as a lab that reads policy.json alone."""
    request = json.loads((folder / "policy.json").read_text())
    task = PointMass(request["time_step"], request["frames"])
    start = np.array([state["start"] for state in request["states"]])
    parameters = np.array(request["policy"]["parameters"])
    made = InTheWind(task).run(Spring(task), parameters, start, np.random.default_rng(0))
    times = task.time_step * np.arange(len(made.states))
    table = np.column_stack([times, made.states, np.concatenate([made.inputs, [[0.0]]])])
    written(folder, lines(",".join(header(task)), table))


@pytest.mark.slow
def test_a_trial_waits_for_a_person_and_resumes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Request by request, with a wrong file between; it ends as the trial on the simulated hardware.

    The controller of its last policy, written afterwards, is that of the last request.
    """
    store = ["tracking=folders", "tracking.pictures=false", f"tracking.trials={folder / 'trials'}"]
    command = ["--config-dir", str(OWN_CONF), "--allow", "point_mass", *OWN, "hardware=manual", *store]
    status, answered = main(command), 0
    while status == WAITING:
        error = capsys.readouterr().err
        (asked,) = (each for each in Path("requests").iterdir() if not (each / "trajectory.csv").exists())
        assert f"run the experiment of {asked}/README.txt, and put its trajectory.csv there" in error
        assert f"({answered} hardware experiment{'s' * (answered != 1)} kept; " in error
        if answered == 1:
            (before,) = Path("requests").glob("*/trajectory.csv")
            shutil.copy(before, asked)
            assert main(command) == BAD_INPUT
            copied = f"{asked}/trajectory.csv: is the answer to another request, {before}"
            assert copied in capsys.readouterr().err
            (asked / "trajectory.csv").write_text("time (s),position (m)\n0,0\n")
            assert main(command) == BAD_INPUT
            line = capsys.readouterr().err
            assert f"{asked}/trajectory.csv: row 1: expected a column velocity (m/s), got none" in line
            assert "(1 hardware experiment kept)" in line
        answer(asked)
        answered += 1
        status = main(command)
    assert status == SUCCEEDED
    simulated = list(build(compose([*OWN, "hardware=point_mass"], OWN_CONF)).run())
    assert answered == simulated[-1].total_experiments == len(list(Path("requests").iterdir()))
    (trial,) = Path("trials").glob("*/outcome.json")
    own = ["--config-dir", str(OWN_CONF), "--allow", "point_mass"]
    assert main(["controller", str(trial.parent), "mine", *own]) == SUCCEEDED
    assert "mine: controller.h, controller.py, policy.json of the last policy of " in capsys.readouterr().out
    for name in "controller.h", "controller.py":
        title, *law = Path("mine", name).read_text().splitlines()
        assert law == (asked / name).read_text().splitlines()[1:]
        assert title.endswith("succeeded")
    description = json.loads((file := trial.with_name("trial.json")).read_text())
    file.write_text(json.dumps(description | {"code": {"mine": "another"}}))
    assert main(["controller", str(trial.parent), "mine", *own]) == SUCCEEDED
    changed = "succeeded, but its code or files have changed since (mine, point_mass)"
    assert all(changed in Path("mine", name).read_text() for name in ("controller.h", "controller.py"))


def run(study: Study, folder: Path, start: Array, seed: int = 3, safety: Safety | None = None) -> str:
    """The one line of an experiment whose result is not there yet."""
    conditions = ExperimentConditions(safety=safety or Safety())
    manual = Manual(study.task, str(folder))
    with pytest.raises(Waiting) as waiting:
        replace(study, hardware=manual, conditions=conditions).experiment(
            THETA, np.random.default_rng(seed), start
        )
    return str(waiting.value)


@pytest.mark.slow
def test_a_request_is_found_again_and_is_not_another_ones(point_mass: Study, tmp_path: Path) -> None:
    """Wherever it was written, whatever its number; one that says anything else is another one."""
    start = point_mass.task.start_mean
    for place in ("here", "there"):
        for seed in (3, 4, 3):
            run(point_mass, tmp_path / place, start, seed)
    names = [sorted(path.name for path in (tmp_path / place).iterdir()) for place in ("here", "there")]
    assert names[0] == names[1]
    assert len(names[0]) == 2
    assert not list(tmp_path.glob("*/.*"))
    for path in (tmp_path / "here").iterdir():
        answer(path)
    weaker = Safety(inputs={"force": 3.0})  # than the experiments that were made
    assert "README.txt" in run(point_mass, tmp_path / "here", start, 3, weaker)
    assert len(list((tmp_path / "here").iterdir())) == 3
    (first,) = (tmp_path / "here").glob("000_*")
    shutil.rmtree(first)
    run(point_mass, tmp_path / "here", start, 5)  # no number is given twice
    assert sorted(path.name[:3] for path in (tmp_path / "here").iterdir()) == ["001", "002", "003"]


def test_the_name_is_a_hash_of_everything_that_a_request_says(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Task, law and limits, not the words of generated code: a lab runs nothing else under its name."""
    task, start = PointMass(), PointMass().start_mean
    base = requested(task, start)
    assert base.code("") != {}
    assert base.name
    monkeypatch.setattr(controller, "MODULE", controller.MODULE + "# of another version\n")
    assert requested(PointMass(), start.copy()).name == base.name
    theta = np.array([1.0, -2.0, 3.0, 0.5, -1.0])
    paper = ExperimentRequest(study.task, study.policy, theta, study.task.start_mean)
    others = [
        requested(task, start + 1e-9),
        requested(PointMass(time_step=0.01), start),
        requested(PointMass(horizon=99), start),
        requested(_with(criteria=(task.criteria[0]._replace(limit=2.0),)), start),
        requested(_with(criteria=(task.criteria[0]._replace(words="too far"),)), start),
        requested(_with(inputs=(task.inputs[0]._replace(unit="kN"),)), start),
        requested(_with(start_deviation=np.array([0.02, 0.01])), start),
        *(requested(task, start, safety) for safety in (
            Safety(inputs={"force": 3.0}),
            Safety(input_rates={"force": 3.0}),
            Safety(states={"velocity": 3.0}),
            Safety(criteria=True),
        )),
        replace(base, token=1),
        replace(base, theta=base.theta + 1e-9),
        paper,
        replace(paper, policy=OutputFeedback(_with_outputs(study.task, 1.1))),
    ]  # fmt: skip
    assert len({base.name, *(each.name for each in others)}) == 1 + len(others)


def _with(**values: object) -> PointMass:
    """The task with other attributes."""
    task = PointMass()
    for name, value in values.items():
        setattr(task, name, value)
    return task


def _with_outputs(task, factor: float):
    """A task whose outputs have other constants, which only the generated code says."""
    other = copy(task)
    other.output = lambda x: factor * task.output(x)
    return other


@pytest.mark.slow
def test_a_person_reads_start_limits_and_what_to_do(point_mass: Study, tmp_path: Path) -> None:
    safety = Safety(states={"velocity": 0.3}, input_rates={"force": 5.0})
    folder = write_request(requested(point_mass.task, np.array([0.5, 0.0]), safety), tmp_path)
    files = ["README.txt", "controller.h", "controller.py", "policy.json", "template.csv"]
    assert sorted(path.name for path in folder.iterdir()) == files
    text = (folder / "README.txt").read_text()
    for line in (
        "position = 0.5 m (refused if it is off by more than 0.2, 20 deviations of the task's starts)",
        "|velocity| <= 0.3 m/s",
        "|change of force| <= 5 N per s",
        "|force| <= 5 N",
    ):
        assert f"  {line}\n" in text
    assert "|position|" not in text
    assert "If the\ncontroller aborted, end the file with the row in which it did" in text
    rows = np.array([[0.0, 0.5, 0.0, 1.0], [0.02, 0.5, 0.0, 0.0]])
    table = lines(",".join([*header(point_mass.task), "failure"]), rows, "unsafe_rate_of_force")
    request = requested(point_mass.task, np.array([0.5, 0.0]), safety)
    assert read(written(folder, table), request).failure == "unsafe_rate_of_force"
    assert "The controller is in controller.h (C99) and controller.py (Python)" in text


@pytest.mark.slow
def test_a_withdrawn_answer_is_taken_by_no_trial(
    point_mass: Study, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Until then trials share the answer to an equal request, and a line says so."""
    requests = tmp_path / "requests"
    study = replace(point_mass, hardware=Manual(point_mass.task, str(requests)))
    assert run_trial(study, tmp_path / "first").outcome is Outcome.WAITING
    (first,) = requests.iterdir()
    answer(first)
    assert run_trial(study, tmp_path / "first").summary.experiments == 1
    assert "made for another trial" not in caplog.text
    assert run_trial(study, tmp_path / "second").summary.experiments == 1
    assert f"{first}/trajectory.csv was made for another trial" in caplog.text
    withdraw(tmp_path / "first" / "0001_experiment.npz", "a loose cable")
    record = run_trial(study, tmp_path / "third")
    assert (record.outcome, record.summary.experiments) == (Outcome.WAITING, 0)
    anew = requests / f"002_{first.name.partition('_')[2]}"
    answer(anew)
    assert run_trial(study, tmp_path / "third").summary.experiments == 1
    shutil.rmtree(requests)
    withdraw(tmp_path / "second" / "0001_experiment.npz")
    assert f"{first}/trajectory.csv does not exist, so it is not marked as withdrawn" in caplog.text


@pytest.mark.slow
def test_a_trajectory_of_another_start_is_refused(point_mass: Study, tmp_path: Path) -> None:
    start = point_mass.task.start_mean
    run(point_mass, tmp_path, start)
    (folder,) = tmp_path.iterdir()
    answer(folder)
    study = replace(point_mass, hardware=Manual(point_mass.task, str(tmp_path)))
    assert study.experiment(THETA, np.random.default_rng(3), start).sensed
    text = (folder / "trajectory.csv").read_text().replace("0.0,0.5,", "0.0,0.2,", 1)
    (folder / "trajectory.csv").write_text(text)
    with pytest.raises(ConfigError, match=r"trajectory\.csv: row 2, column position: expected the start"):
        study.experiment(THETA, np.random.default_rng(3), start)
    (tmp_path / "file").touch()
    hardware = Manual(point_mass.task, str(tmp_path / "file"))
    with pytest.raises(HardwareError, match=r"file: the request cannot be written"):
        hardware.run(point_mass.policy, THETA, np.zeros(2), np.random.default_rng(0))
