"""Hardware that misbehaves: the trial ends in one line, nothing is lost, and mended it resumes."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faulty_hardware import CONF, DEADLY, MENDED, RAISED, RETURNED, Faulty
from hardware import Doing
from records import assert_equal, step_names, timeless
from texts import write
from trial_process import start

import simbias
from simbias.core import Bias, FittedBias
from simbias.core.records import Transitions
from simbias.learning.bias.none import ConstantBias
from simbias.trial import record as folders
from simbias.trial.folder import TrialFolder
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.run import TrialRecord, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

pytestmark = pytest.mark.slow

SHORT = [
    *("tracking=none", "task.horizon=80", "optimizer.max_evaluations=5", "method.max_iterations=2"),
    "cost.max_cost=1e-3",  # never reached
]


@pytest.fixture(scope="module")
def study() -> Study:
    return simbias.load(SHORT)


@pytest.fixture(scope="module")
def uninterrupted(study: Study) -> TrialRecord:
    return timeless(run_trial(study))


def faulty(study: Study, fault: str) -> Study:
    return replace(study, hardware=Faulty(study.task, fault))


def test_whatever_a_hardware_does_the_trial_ends_in_one_line(
    study: Study, uninterrupted: TrialRecord, folder: Path
) -> None:
    """What it returned is kept; mended, the trial resumes as uninterrupted, and has no error any more."""
    faults = (*list(RAISED)[::2], "own words", *list(RETURNED)[::4])  # test_checked_hardware.py has them all
    for number, fault in enumerate(faults):
        trial = folder / str(number)
        record = run_trial(faulty(study, fault), trial)
        assert (record.outcome, record.summary.experiments) == (Outcome.ERROR, 1), fault
        assert record.summary.reason.startswith("HardwareError: ")
        assert "\n" not in record.summary.reason
        assert "expected" in record.summary.reason or fault == "own words"
        assert Path(record.summary.traceback_file).read_text() == record.traceback
        kept = {path.name for path in trial.glob("refused_*")}
        assert kept == ({"refused_0000.json"} if fault in RETURNED else set())
        assert step_names(trial) == ["search", "experiment"]  # else it would be replayed for ever
        (folder / MENDED).touch()
        assert_equal(timeless(run_trial(faulty(study, fault), trial)), uninterrupted)
        (folder / MENDED).unlink()
        stopped, ended = TrialFolder(trial).attempts()[1]["stopped"], TrialFolder(trial).summary()
        assert ended is not None
        assert (stopped["outcome"], ended.outcome) == ("error", Outcome.NOT_SUCCEEDED)
        assert ended.reason == uninterrupted.summary.reason


class Odd:
    def __init__(self) -> None:
        self.angles = [1, 2, 3]
        self.camera = {"left"}


class Silent:
    def __repr__(self) -> str:
        raise ValueError


LONG = np.arange(3000.0) / 7.0
CIRCLE: list[object] = []
CIRCLE.append(CIRCLE)
REFUSED: list[tuple[object, object]] = [  # what is returned, and what is kept of it
    (None, None),
    ([LONG, "caf\udce9", {}, np.float32(0.5)], [LONG.tolist(), "caf\udce9", {}, 0.5]),
    ({"a b": 1.5, "file": [1, [2]], "c": 2j}, {"a b": 1.5, "file": [1, [2]], "c": "2j"}),
    (Odd(), {"angles": [1, 2, 3], "camera": "{'left'}"}),
    (Silent(), "a Silent that cannot be shown"),
    (np.array([LONG, None], dtype=object), [LONG.tolist(), None]),
    (CIRCLE, "[[...]]"),
]


def test_all_that_a_hardware_returned_is_kept_each_time(study: Study, tmp_path: Path) -> None:
    """Every number in full; what is no number in words."""
    for number, (returned, expected) in enumerate(REFUSED):
        hardware = Doing(study.hardware, lambda _, returned=returned: returned)
        file = tmp_path / f"refused_{number:04d}.json"
        record = run_trial(replace(study, hardware=hardware), tmp_path)
        assert record.summary.reason.endswith(f"; it is kept in {file}")
        kept = json.loads(file.read_text())
        assert kept["returned"] == expected
        assert (len(kept["parameters"]), len(kept["start"])) == (5, 6)
        assert kept["why"].startswith("Doing.run: expected a Rollout, got ")


def test_what_cannot_be_kept_hides_no_reason(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folders, "write_whole", full)
    run = folders.FolderRecord(tmp_path, study)
    told = run.refuse(None, np.zeros(5), np.zeros(6), "why")
    assert told.startswith("; it could not be kept (")
    assert "No space left on device" in told
    assert run.traceback("text") == ""


def test_a_hardware_that_hangs_is_stopped(
    folder: Path, uninterrupted: TrialRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit on an experiment's time is no part of the trial's identity."""
    monkeypatch.setattr("simbias.lab.checked_hardware.STOP_SECONDS", 0.2)
    begun, limited = time.monotonic(), simbias.load([*SHORT, "experiment_timeout=0.5"])
    record = run_trial(faulty(limited, "hangs"), folder / "trial")
    assert time.monotonic() - begun < 20
    reason = "Faulty.run: expected an end within 0.5 s (experiment_timeout), got none"
    assert reason in record.summary.reason
    assert (folder / "stopped").exists()
    (folder / MENDED).touch()
    patient = simbias.load([*SHORT, "experiment_timeout=60"])
    assert patient.hash == limited.hash
    assert_equal(timeless(run_trial(faulty(patient, "hangs"), folder / "trial")), uninterrupted)


def test_a_trial_whose_process_ends_resumes(uninterrupted: TrialRecord, folder: Path) -> None:
    conf = write(folder / "conf", CONF)
    for number, (fault, status) in enumerate({"_exit": 7, "SIGSEGV": -11, "SIGKILL": -9}.items()):
        assert fault in DEADLY
        trial, overrides = folder / str(number), [*SHORT, "hardware=faulty", f"hardware.fault={fault}"]
        process = start(trial, overrides, conf)
        process.join(60)
        assert process.exitcode == status
        assert step_names(trial) == ["search", "experiment"]
        (folder / MENDED).touch()
        assert_equal(timeless(run_trial(simbias.load(overrides, conf), trial)), uninterrupted)
        (folder / MENDED).unlink()


class Diverging(Bias):
    """Learns infinity from the data of two experiments, unless it has been mended."""

    def __init__(self, mended: bool = False) -> None:
        self._mended = mended

    def fit(self, transitions: Transitions) -> FittedBias:
        diverges = len(transitions) > 10 and not self._mended
        return ConstantBias(np.full(2, np.inf if diverges else 0.0), np.zeros(2))


@pytest.mark.usefixtures("uncompiled")
def test_a_learner_whose_correction_is_not_finite_ends_the_trial(hasty: Study, folder: Path) -> None:
    """Before an experiment with a policy of its model; mended, the trial resumes as uninterrupted."""
    vars(hasty.cost)["max_cost"] = 1e-3  # never reached
    method = ModelBased(max_iterations=3, experiments=1, keep_data=True)
    mended = replace(hasty, method=method, bias=Diverging(mended=True))
    record = run_trial(replace(mended, bias=Diverging()), folder)
    reason = "ValueError: ConstantBias.correction: expected finite numbers, got inf (none.py:"
    assert record.summary.reason.startswith(reason)
    assert (record.outcome, record.summary.experiments) == (Outcome.ERROR, 2)
    assert_equal(timeless(run_trial(mended, folder)), timeless(run_trial(mended)))
