"""Processes that are killed, and two at once: no experiment is lost or made twice."""

import json
import random
import signal
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from logged_hardware import LOG
from records import assert_equal, made, step_names, timeless
from texts import write
from trial_process import start

import simbias
from simbias.config import ConfigError
from simbias.trial.folder import TrialFolder
from simbias.trial.run import TrialRecord, read_trial, run_trial

pytestmark = pytest.mark.slow

KILLS = 2
Uninterrupted = tuple[TrialRecord, list[list[float]]]  # the record, and the starts of its experiments
SHORT = [
    *("tracking=none", "task.horizon=200", "optimizer.max_evaluations=20", "method.max_iterations=4"),
    "cost.max_cost=1e-3",  # never reached
    "hardware=logged",
]


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    logged = {"hardware/logged.yaml": "_target_: logged_hardware.Logged\nseconds: 0.05\n"}
    return write(tmp_path_factory.mktemp("conf"), logged | {"components.yaml": "allow: [logged_hardware]\n"})


@pytest.fixture(scope="module")
def uninterrupted(conf: Path, tmp_path_factory: pytest.TempPathFactory) -> Uninterrupted:
    folder = tmp_path_factory.mktemp("uninterrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return timeless(run_trial(simbias.load(SHORT, conf))), begun(folder)


def begun(folder: Path) -> list[list[float]]:
    """The starts of the experiments that were begun."""
    log = folder / LOG
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def until_begun(process: BaseProcess, folder: Path, count: int) -> None:
    """Wait until so many experiments have been begun."""
    while len(begun(folder)) < count and process.is_alive():
        time.sleep(0.01)


def test_killed_again_and_again_a_trial_ends_as_uninterrupted(
    conf: Path, uninterrupted: Uninterrupted, tmp_path: Path
) -> None:
    expected, starts = uninterrupted
    assert len(starts) == 8
    rng, folder = random.Random(2015), tmp_path / "trial"
    for number in range(KILLS + 1):
        safe, earlier = made(step_names(folder)), len(begun(tmp_path))
        process = start(folder, SHORT, conf)
        if number < KILLS:
            until_begun(process, tmp_path, earlier + 1)
            time.sleep(rng.uniform(0.0, 0.1))
            process.kill()
        process.join(120)
        assert process.exitcode == (-signal.SIGKILL if number < KILLS else 0)
        began = begun(tmp_path)[earlier:]
        assert began == starts[safe : safe + len(began)]  # none that was kept is made again
        assert made(step_names(folder)) >= safe + len(began) - 1  # all but the one under way
    assert began[-1] == starts[-1]
    study = simbias.load(SHORT, conf)
    for record in (run_trial(study, folder), read_trial(study, folder)):
        assert_equal(timeless(record), expected)
    assert sum("started" in each for each in TrialFolder(folder).attempts()) == KILLS + 1


def test_two_processes_do_not_make_the_same_trial(
    conf: Path, uninterrupted: Uninterrupted, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one gives up, or waits until the first has ended, and then finds what that made."""
    study, trial = simbias.load(SHORT, conf), folder / "trial"
    process = start(trial, SHORT, conf)
    until_begun(process, folder, 1)
    monkeypatch.setattr("simbias.trial.folder.LOCK_SECONDS", 0.1)
    with pytest.raises(ConfigError, match="another process is running this trial"):
        run_trial(study, trial)
    monkeypatch.setattr("simbias.trial.folder.LOCK_SECONDS", 60.0)
    record = run_trial(study, trial)
    process.join(120)
    assert process.exitcode == 0
    assert_equal(timeless(record), uninterrupted[0])
    assert begun(folder) == uninterrupted[1]
    assert len(TrialFolder(trial).attempts()) == 1
