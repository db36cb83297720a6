"""A sweep that is killed and started again gives what an undisturbed one gives, trial by trial."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path

import pytest
from sweeping import (
    FOUR_CELLS,
    artifacts,
    finish,
    run,
    runs,
    start,
    table,
    trial_by_trial,
    until_trials,
    workers,
    write_sweep,
)

pytestmark = pytest.mark.slow

COMMAND = ["--config-dir", "conf", "+sweep=mine"]
ONE_PROCESS = "engine=sequential"  # where it is the parent that something happens to
TRIALS = 20  # so many that some are left after every killing
ENDINGS = [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]


@pytest.fixture(scope="session")
def empty(new_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store and a sweep, in which nothing ran."""
    folder = tmp_path_factory.mktemp("empty")
    write_sweep(folder, "mine", FOUR_CELLS)
    shutil.copy(new_store, folder)
    return folder


@pytest.fixture(scope="session")
def undisturbed(empty: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed") / "here"
    shutil.copytree(empty, folder)
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder)
    assert (status, err) == (0, "")
    assert f"[{TRIALS}/{TRIALS}]" in out
    assert len(trial_by_trial(folder)) == TRIALS
    return folder


@pytest.fixture
def folder(empty: Path, tmp_path: Path) -> Path:
    shutil.copytree(empty, tmp_path / "here")
    return tmp_path / "here"


def check(folder: Path, undisturbed: Path) -> None:
    """Everything is as if nothing had happened."""
    assert trial_by_trial(folder) == trial_by_trial(undisturbed)
    assert table(folder) == table(undisturbed)
    assert {run.info.status for run in runs(folder)[0]} == {"FINISHED"}


def finished(folder: Path) -> set[str]:
    """Trials' runs that are finished."""
    return {run.info.run_id for run in runs(folder)[1] if run.info.status == "FINISHED"}


@pytest.mark.parametrize("seed", [0])
def test_killed_again_and_again(folder: Path, undisturbed: Path, seed: int) -> None:
    """At random points: by Ctrl-C, politely, for good, and one of its workers."""
    rng = random.Random(seed)
    done: set[str] = set()
    orphans: list[int] = []
    for number in rng.sample(ENDINGS, len(ENDINGS)):
        process = start(*COMMAND, folder=folder)
        until_trials(process, rng.randint(1, 2))
        time.sleep(rng.uniform(0.0, 0.15))
        orphans += workers(process)
        process.send_signal(number)
        status, _, err = finish(process)
        if number == signal.SIGKILL:
            assert status == -signal.SIGKILL
        else:
            assert status == 130
            assert "simbias: interrupted; " in err
            assert "-m simbias --config-dir conf +sweep=mine" in err.partition("Go on with:  ")[2]
            assert "Traceback" not in err
        assert done < finished(folder)  # none is lost, none runs twice
        done = finished(folder)
    process = start(*COMMAND, folder=folder)
    until_trials(process, 1)
    os.kill(rng.choice(workers(process)), signal.SIGKILL)
    status, out, err = finish(process)
    assert (status, err) == (0, ""), out + err
    assert done < finished(folder)
    check(folder, undisturbed)
    assert orphans
    assert not [pid for pid in orphans if alive(pid)]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


def test_disk_is_full(folder: Path, undisturbed: Path) -> None:
    """Files may not grow beyond what the store has now: SQLite cannot write, as on a full disk."""
    limit = (folder / "mlflow.db").stat().st_size + 20_000
    status, _, err = run(
        *COMMAND,
        folder=folder,
        largest_file=limit,
    )
    assert status == 1
    assert "-m simbias --config-dir conf +sweep=mine" in err.partition("Go on with:  ")[2]
    assert "Traceback" not in err
    assert run(*COMMAND, ONE_PROCESS, folder=folder)[0] == 0
    check(folder, undisturbed)


def test_one_sweep_at_a_time(folder: Path) -> None:
    process = start(*COMMAND, ONE_PROCESS, folder=folder)
    until_trials(process, 1)
    process.send_signal(signal.SIGSTOP)
    status, out, err = run(*COMMAND, folder=folder)
    assert (status, out) == (2, "")
    assert err == "simbias: sweep: another process is running this sweep into the same store\n"
    process.kill()
    finish(process)


def kill(folder: Path, temporary: Path, trials: int) -> None:
    """Kill a sweep and all its processes once this many trials have ended."""
    process = start(*COMMAND, folder=folder, temporary=temporary)
    until_trials(process, trials)
    os.killpg(process.pid, signal.SIGKILL)
    assert finish(process)[0] == -signal.SIGKILL


def test_a_later_start_removes_what_a_kill_left(folder: Path, undisturbed: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    for trials in (1, 2):
        kill(folder, temporary, trials)
    assert list(temporary.iterdir())
    (parent,) = runs(folder)[0]
    (artifacts(parent) / "sweep.yaml").unlink()  # as if it had been killed before it wrote that
    left = artifacts(parent) / ".artifact.uploading.x1"
    left.touch()
    assert run(*COMMAND, folder=folder, temporary=temporary)[0] == 0
    check(folder, undisturbed)
    assert list(temporary.iterdir()) == []
    assert not list(folder.rglob("*.artifact.uploading.*"))
    assert "time_step" in (artifacts(parent) / "sweep.yaml").read_text()
    assert not (folder / "journals").exists()
