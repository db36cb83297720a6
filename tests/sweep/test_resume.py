"""A sweep that is killed and started again gives what an uninterrupted one gives, trial by trial."""

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
    finish,
    run,
    start,
    state,
    sweep_folder,
    table,
    trial_by_trial,
    until_trials,
    workers,
    write_sweep,
)

pytestmark = pytest.mark.slow

COMMAND = ["--config-dir", "conf", "+sweep=mine", "tracking=folders"]
ONE_PROCESS = "engine=sequential"  # where it is the parent that something happens to
TRIALS = 16  # enough that some are left after every kill
ENDINGS = [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_sweep(tmp_path / "here", "mine", FOUR_CELLS)
    return tmp_path / "here"


@pytest.fixture(scope="session")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted")
    write_sweep(folder, "mine", FOUR_CELLS)
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder)
    assert (status, err) == (0, "")
    assert f"[{TRIALS}/{TRIALS}]" in out
    assert len(trial_by_trial(folder)) == TRIALS
    return folder


def check(folder: Path, uninterrupted: Path) -> None:
    """Everything is as if nothing had happened, and nothing is left over."""
    assert trial_by_trial(folder) == trial_by_trial(uninterrupted)
    assert table(folder) == table(uninterrupted)
    assert state(folder)["verdict"] == "**Done**"
    assert not [*folder.rglob("*.part"), *folder.rglob(".shared_*")]


def finished(folder: Path) -> dict[str, int]:
    """When the trials ended that have."""
    return {file.parent.name: file.stat().st_mtime_ns for file in folder.glob("trials/*/outcome.json")}


def test_killed_again_and_again(folder: Path, uninterrupted: Path) -> None:
    """At random points: by Ctrl-C, politely, for good, and one of its workers."""
    rng = random.Random(0)
    done: dict[str, int] = {}
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
            assert "-m simbias --config-dir conf +sweep=mine" in err.partition("Resume with:  ")[2]
            assert "Traceback" not in err
            assert state(folder)["verdict"] == "**Interrupted**"
        assert done.items() < finished(folder).items()  # none is lost, none runs twice
        done = finished(folder)
    process = start(*COMMAND, folder=folder)
    until_trials(process, 1)
    os.kill(rng.choice(workers(process)), signal.SIGKILL)
    status, out, err = finish(process)
    assert (status, err) == (0, ""), out + err
    assert done.items() < finished(folder).items()
    check(folder, uninterrupted)
    assert orphans
    assert not [pid for pid in orphans if alive(pid)]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"


def test_disk_is_full(folder: Path, uninterrupted: Path) -> None:
    """Files may not grow beyond the size of half an experiment: none can be kept, as on a full disk."""
    kept = next(uninterrupted.glob("trials/*/*_experiment.npz")).stat().st_size
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder, largest_file=kept // 2)
    assert status == 1
    assert "OSError: [Errno 27] File too large" in out
    assert "Traceback" not in out + err
    assert not list(folder.glob("trials/*/*_experiment.npz"))
    assert run(*COMMAND, ONE_PROCESS, folder=folder)[0] == 0
    check(folder, uninterrupted)


def test_one_sweep_at_a_time(folder: Path) -> None:
    process = start(*COMMAND, ONE_PROCESS, folder=folder)
    until_trials(process, 1)
    process.send_signal(signal.SIGSTOP)
    status, out, err = run(*COMMAND, folder=folder)
    assert (status, out, err) == (2, "", "simbias: sweep: another process is running this sweep\n")
    process.kill()
    finish(process)


def test_a_trial_that_was_killed_before_its_picture_was_drawn(folder: Path) -> None:
    command = [*COMMAND, ONE_PROCESS, "tracking.pictures=true", "sweep.trials=1"]
    assert run(*command, folder=folder)[0] == 0
    first, *others = sorted(folder.glob("trials/*/pictures"))
    shutil.rmtree(first)
    status, out, _ = run(*command, folder=folder)
    assert (status, f"{len(others)} of them finished already" in out) == (0, True)
    assert (first / "overview.png").exists()


def kill(folder: Path, temporary: Path, trials: int) -> None:
    """Kill a sweep and all its processes once this many trials have ended."""
    process = start(*COMMAND, folder=folder, temporary=temporary)
    until_trials(process, trials)
    os.killpg(process.pid, signal.SIGKILL)
    assert finish(process)[0] == -signal.SIGKILL


def test_a_later_start_removes_what_a_kill_left(folder: Path, uninterrupted: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    for trials in (1, 2):
        kill(folder, temporary, trials)
    assert list(temporary.iterdir())
    assert list(sweep_folder(folder).glob(".shared_*"))
    assert run(*COMMAND, folder=folder, temporary=temporary)[0] == 0
    check(folder, uninterrupted)
    assert list(temporary.iterdir()) == []
