"""A sweep that is killed and started again gives what an uninterrupted one gives, trial by trial."""

import shutil
import signal
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from threading import Timer

import pytest
from filelock import FileLock
from processes import runs as alive
from sweeping import (
    FOUR_CELLS,
    QUICK,
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

from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.engine.sequential import Sequential
from simbias.sweep.grid import Trial
from simbias.sweep.worker import PlannedTrial, Result, run_plan
from simbias.terminal.sweep import SweepConsole
from simbias.trial.disk import locked
from simbias.trial.folder import TrialFolder, withdraw

pytestmark = pytest.mark.slow

COMMAND = ["--config-dir", "conf", "+sweep=mine", "sweep.trials=2", "tracking=folders"]
ONE_PROCESS = "engine=sequential"  # where it is the parent that something happens to


@pytest.fixture
def folder(folder: Path) -> Path:
    """The working folder, with the sweep."""
    write_sweep(folder, "mine", FOUR_CELLS)
    return folder


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted")
    write_sweep(folder, "mine", FOUR_CELLS)
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder)
    assert (status, err) == (0, "")
    assert "[8/8]" in out
    assert len(trial_by_trial(folder)) == 8
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
    """By Ctrl-C, politely and for good."""
    done: dict[str, int] = {}
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        process = start(*COMMAND, ONE_PROCESS, folder=folder)
        until_trials(process, 1)
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
    assert main([*COMMAND, ONE_PROCESS]) == 0
    assert done.items() < finished(folder).items()
    check(folder, uninterrupted)


def test_disk_is_full(folder: Path, uninterrupted: Path) -> None:
    """Files may not grow beyond the size of half an experiment: none can be kept, as on a full disk."""
    kept = next(uninterrupted.glob("trials/*/*_experiment.npz")).stat().st_size
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder, largest_file=kept // 2)
    assert status == 1
    assert "OSError: [Errno 27] File too large" in out
    assert "Traceback" not in out + err
    assert not list(folder.glob("trials/*/*_experiment.npz"))
    assert main([*COMMAND, ONE_PROCESS]) == 0
    check(folder, uninterrupted)


def test_a_later_start_removes_what_a_kill_left(
    folder: Path, uninterrupted: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """While a sweep runs, no other process may run it. Workers die in `tests/engine/test_engines.py`."""
    temporary = tmp_path_factory.mktemp("temporary")
    process = start(*COMMAND, folder=folder, temporary=temporary)
    until_trials(process, 1)
    process.send_signal(signal.SIGSTOP)
    assert run(*COMMAND, folder=folder) == (2, "", "simbias: sweep: another process is running this sweep\n")
    orphans = workers(process)
    process.kill()
    assert finish(process)[0] == -signal.SIGKILL
    assert list(temporary.iterdir())
    assert list(sweep_folder(folder).glob(".shared_*"))
    done = finished(folder)
    status, out, err = run(*COMMAND, ONE_PROCESS, folder=folder, temporary=temporary)
    assert (status, err) == (0, ""), out + err
    assert done.items() < finished(folder).items()
    check(folder, uninterrupted)
    assert list(temporary.iterdir()) == []
    assert orphans
    assert not any(map(alive, orphans))


def test_trials_that_another_process_runs_are_tried_again_at_the_end(
    folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two sweeps may share trials; one that still runs elsewhere has not ended, which is no error."""

    def other_ends(console: SweepConsole, trial: Trial, result: Result) -> None:
        if len(finished(folder)) == 7:
            stack.close()
        told(console, trial, result)

    monkeypatch.setattr("simbias.trial.folder.LOCK_SECONDS", 0.1)
    told, first = SweepConsole.ended, next(uninterrupted.glob("trials/*/outcome.json")).parent.name
    with ExitStack() as stack:
        stack.enter_context(TrialFolder(folder / "trials" / first).held())
        assert main([*COMMAND, ONE_PROCESS]) == 3
        assert state(folder)["verdict"].startswith("**Waiting**")
        assert "Another process is running 1 trial; the same" in capsys.readouterr().out
        shutil.rmtree(folder / "trials", ignore_errors=True)
        stack.close()
        stack.enter_context(TrialFolder(folder / "trials" / first).held())
        monkeypatch.setattr(SweepConsole, "ended", other_ends)
        assert main([*COMMAND, ONE_PROCESS]) == 0
    check(folder, uninterrupted)


def test_a_picture_that_is_not_there_is_drawn_later(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk was full, or the trial was killed before it was drawn; how the trial ended stays as it is."""

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    write_sweep(folder, "mine", "sweep: {trials: 1, figures: {}, axes: {bias: [gp]}}")
    command = ["--config-dir", "conf", "+sweep=mine", "tracking=folders", *QUICK, ONE_PROCESS]
    with monkeypatch.context() as patch:
        patch.setattr("simbias.pictures.trial.gallery.write_whole", full)
        with pytest.warns(RuntimeWarning, match="No space left on device"):
            assert main(command) == 0
    assert "error" not in state(folder)["outcomes"]
    (pictures,) = folder.glob("trials/*/pictures")
    for _ in range(2):
        assert main(command) == 0
        assert (pictures / "overview.png").exists()
        shutil.rmtree(pictures)


def test_looking_whether_a_sweep_runs_stops_no_start(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def looked_at(path: Path, timeout: float, taken: ConfigError) -> AbstractContextManager[None]:
        path.parent.mkdir(parents=True)
        looking = FileLock(path, thread_local=False)
        looking.acquire()
        Timer(0.1, looking.release).start()
        return locked(path, timeout, taken)

    monkeypatch.setattr("simbias.sweep.running.locked", looked_at)
    write_sweep(folder, "mine", "sweep: {trials: 1, figures: {}, axes: {bias: [none]}}")
    assert main([*COMMAND, *QUICK, ONE_PROCESS, "sweep.trials=1", "tracking.pictures=false"]) == 0


def test_a_folder_from_elsewhere_is_laid_out_once_nobody_runs_its_trial_here(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trial is tried again at the end."""
    holding, steps = ExitStack(), []

    def elsewhere(plan: PlannedTrial) -> Result:
        trial = TrialFolder(Path(str(plan.folder)))
        steps.append(trial.steps())
        holding.enter_context(trial.held()) if len(steps) == 1 else holding.close()
        return run_plan(plan._replace(marker="not here"))

    monkeypatch.setattr("simbias.sweep.running.run_plan", elsewhere)
    monkeypatch.setattr("simbias.trial.folder.LOCK_SECONDS", 0.1)
    monkeypatch.setattr(Sequential, "shares_disk", False)
    write_sweep(folder, "mine", "sweep: {trials: 1, figures: {}, axes: {bias: [none]}}")
    assert main([*COMMAND, *QUICK, ONE_PROCESS, "sweep.trials=1", "tracking.pictures=false"]) == 0
    assert steps == [[], []]
    assert len(finished(folder)) == 1


def test_what_is_done_here_meanwhile_stays(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A trial travels as it is when a worker takes it; changed here since, it is tried again at the end."""
    write_sweep(folder, "mine", "sweep: {trials: 2, figures: {}, axes: {bias: [none]}}")
    command = [*COMMAND, *QUICK, ONE_PROCESS, "tracking.pictures=false", "cost.max_cost=1e-3"]
    assert main(command) == 0
    trials, taken = finished(folder), []
    for trial in trials:
        (folder / "trials" / trial / "outcome.json").unlink()

    def elsewhere(plan: PlannedTrial) -> Result:
        result = run_plan(plan._replace(marker="not here"))
        if not taken:
            for trial in trials:
                withdraw(folder / "trials" / trial / "0001_experiment.npz")
        taken.append(Path(str(plan.folder)).name)
        return result

    monkeypatch.setattr("simbias.sweep.running.run_plan", elsewhere)
    monkeypatch.setattr(Sequential, "shares_disk", False)
    assert main(command) == 0
    assert taken == [taken[0], taken[1], taken[0]]
    assert f"trial {taken[0]} was run here, or an experiment withdrawn, meanwhile" in caplog.text
    for trial in trials:
        assert len(TrialFolder(folder / "trials" / trial).withdrawals()) == 1
        assert (folder / "trials" / trial / "outcome_1.json").exists()
