"""A trial's folder: on disk before it is used, resumed from any point, read back as far as it goes."""

import errno
import json
import logging
import os
import re
import resource
import shutil
import signal
import stat
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from io import StringIO
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import OWN_CONF, POINT_MASS
from errors import one_line
from filelock import FileLock
from hardware import counted
from records import assert_equal, made, step_names, timeless
from scripted import Guessing

import simbias
from simbias.config import ConfigError
from simbias.config.stored import read_folder
from simbias.core import Hardware, Policy, platform
from simbias.core.interruption import Interruption
from simbias.core.records import Array, Rollout
from simbias.lab import checked_hardware
from simbias.terminal.trial import changed_since
from simbias.trial import record as records
from simbias.trial import step_files
from simbias.trial.disk import LOCK, PART, is_locked, write_whole
from simbias.trial.files import load_rollout
from simbias.trial.folder import ATTEMPTS, EPISODE, EPISODES, EXPERIMENT, OUTCOME, TRIAL, TrialFolder
from simbias.trial.observer import Observer
from simbias.trial.run import TrialRecord, read_trial, run_trial
from simbias.trial.step_files import StepFiles
from simbias.trial.study import Study
from simbias.trial.summary import Outcome

SHORT = [
    *("tracking=none", "task.horizon=100", "optimizer.max_evaluations=10", "method.max_iterations=3"),
    "cost.max_cost=1e-3",  # never reached
    *("policy_test.episodes=2", "policy_test.long_episodes=1", "policy_test.long_seconds=0.2"),
]
ROBUST = [
    *SHORT,
    *("bias=sparse_gp", "evaluation=domain_randomization", "optimizer=hybrid", "method=model_based"),
    *("optimizer.explorations=10", "evaluation.rollouts=3", "evaluation.sample_bias=true"),
    *("method.retry_search=1", "method.stop_at_failure=false", "method.max_iterations=2"),
]
Whole = tuple[Path, TrialRecord]  # the folder of a trial that ended, and its record
EXPERIMENTS = 8  # with the test's


@pytest.fixture(scope="module")
def short() -> Study:
    return simbias.load(SHORT)


@pytest.fixture(scope="module")
def whole(short: Study, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The folder of a trial that ended, and its record."""
    folder = tmp_path_factory.mktemp("trial") / "whole"
    return folder, run_trial(short, folder)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The same of one's own components."""
    folder = tmp_path_factory.mktemp("own")
    few = ["task.horizon=50", "optimizer.max_evaluations=20", "tracking=none"]
    return folder, run_trial(simbias.load([*POINT_MASS, *few], OWN_CONF), folder)


def cut(whole: Path, folder: Path, lost: int) -> Path:
    """A copy of a folder without its last steps, as a kill leaves it."""
    shutil.copytree(whole, folder)
    for file in TrialFolder(folder).steps()[len(step_names(whole)) - lost :]:
        file.unlink()
    (folder / OUTCOME).unlink()
    (folder / EPISODES).unlink()
    return folder


@pytest.mark.slow
def test_an_experiment_is_on_disk_before_it_is_used(short: Study, tmp_path: Path) -> None:
    """And while a process makes it, the trial is locked."""
    kept, locked = [], []

    class Watching(Observer):
        def experimented(self, rollout: Rollout) -> None:
            kept.append(step_names(tmp_path).count("experiment"))
            locked.append(is_locked(tmp_path / LOCK))

    run_trial(short, tmp_path, Watching())
    assert (kept, locked) == ([1, 2, 3, 4, 5, 6], 6 * [True])
    assert not is_locked(tmp_path / LOCK)
    iterations = 3 * ["search", *2 * ["experiment"], "iteration"]
    assert step_names(tmp_path) == [*iterations, *2 * ["test_episode"]]
    for file in tmp_path.glob("*_test_episode.npz"):  # as they were called at first
        file.rename(file.with_name(file.name.replace("test_episode", "experiment")))
    test = read_trial(short, tmp_path).policy_test
    assert test is not None
    assert len(test.episodes) == 2


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [SHORT, ROBUST], ids=["paper", "robust"])
def test_stopped_anywhere_a_trial_ends_as_uninterrupted(overrides: list[str], tmp_path: Path) -> None:
    """However many of its last steps are missing, whatever else a kill left; no experiment is made twice."""
    study = simbias.load([*overrides, "method.max_iterations=2"])
    uninterrupted = timeless(run_trial(study, tmp_path / "whole"))
    assert_equal(timeless(run_trial(study)), uninterrupted)
    names = step_names(tmp_path / "whole")
    for lost in range(len(names) + 1):
        folder = cut(tmp_path / "whole", tmp_path / f"lost {lost}", lost)
        (folder / f"{len(names) - lost:04d}_search.json.part").write_text("{")
        with (folder / ATTEMPTS).open("r+b") as file:
            file.truncate(file.seek(0, 2) - lost)
        same, log = counted(study)
        assert_equal(timeless(run_trial(same, folder)), uninterrupted)
        assert log.count("made") == made(names[len(names) - lost :])
        assert {file.name for file in TrialFolder(folder).files()} == {
            file.name for file in TrialFolder(tmp_path / "whole").files()
        }
        assert len(TrialFolder(folder).attempts()) == (2 if lost == 0 else 1 + (lost < 2))
        for file in TrialFolder(folder).steps():
            if file.suffix == ".npz":
                assert file.read_bytes() == (tmp_path / "whole" / file.name).read_bytes()


def interrupting(function: Callable[..., Any], log: list[str]) -> Callable[..., Any]:
    """The function; the first time after an experiment was made, a signal comes just before."""

    def interrupted(*given: Any) -> Any:
        if log[-1:] == ["made"]:
            log.append("signal")
            signal.raise_signal(signal.SIGINT)
        return function(*given)

    return interrupted


@pytest.mark.slow
@pytest.mark.parametrize("timeout", [None, 60.0])
def test_an_experiment_that_has_ended_is_kept_before_a_signal_interrupts(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timeout: float | None
) -> None:
    """And counted, whether the signal comes while it is checked, packed or written."""
    study, log = counted(replace(short, conditions=replace(short.conditions, timeout=timeout)))
    places = (checked_hardware, "check_rollout"), (records, "packed_rollout"), (StepFiles, "write")
    for count in range(EXPERIMENTS):
        owner, name = places[count % len(places)]
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, interrupting(getattr(owner, name), log))
            with pytest.raises(KeyboardInterrupt), Interruption():
                run_trial(study, tmp_path)
        assert (log.count("made"), made(step_names(tmp_path))) == (count + 1, count + 1)
        assert read_trial(short, tmp_path).summary.experiments == min(count + 1, EXPERIMENTS - 2)
    assert_equal(timeless(run_trial(study, tmp_path)), timeless(whole[1]))
    assert log.count("made") == EXPERIMENTS


@pytest.mark.slow
def test_it_waits_for_each_result_and_resumes(short: Study, tmp_path: Path) -> None:
    """Also for those of the last policy's test, which make no experiment of the trial."""
    study, log = counted(short, slow=True)
    for number in range(EXPERIMENTS):
        record = run_trial(study, tmp_path)
        assert (record.outcome, record.summary.experiments) == (Outcome.WAITING, min(number, 6))
        tested = f"test episode {number - 5} of {EXPERIMENTS - 6}: " if number >= 6 else ""
        assert record.summary.reason == f"{tested}trajectory.csv is not there yet."
    record = run_trial(study, tmp_path)
    assert_equal(timeless(record), timeless(run_trial(short)))
    assert log.count("made") == EXPERIMENTS
    stops = [each["stopped"] for each in TrialFolder(tmp_path).attempts() if "stopped" in each]
    assert [each["outcome"] for each in stops] == EXPERIMENTS * ["waiting"]
    seconds = [each["seconds"] for each in stops]
    assert seconds == sorted(seconds)
    assert 0.0 < seconds[-1] < record.summary.seconds < sum(seconds)  # of all attempts, each once


def test_a_resumed_iteration_tells_the_time_of_its_search(short: Study, whole: Whole, tmp_path: Path) -> None:
    """Where it was made, not where it was replayed; of a folder whose searches do not tell it, none."""
    for name, seconds in ("told", 123.0), ("older", nan):
        folder = cut(whole[0], tmp_path / name, len(step_names(whole[0])) - 2)
        search = json.loads((folder / "0000_search.json").read_text())
        assert 0.0 < search.pop("seconds") <= whole[1].iterations[0].seconds["search"]
        (folder / "0000_search.json").write_text(
            json.dumps(search if isnan(seconds) else {**search, "seconds": seconds})
        )
        record = run_trial(short, folder)
        assert_equal(timeless(record), timeless(whole[1]))
        first, second, *_ = (each.seconds.get("search", nan) for each in record.iterations)
        assert first == pytest.approx(seconds, abs=5.0, nan_ok=True)
        assert 0.0 < second < 5.0
        (folder / OUTCOME).unlink()
        read = read_trial(short, folder)
        assert read.iterations[0].seconds.get("search", nan) == pytest.approx(first, nan_ok=True)
        assert not isnan(read.summary.seconds)
        resumed = run_trial(short, folder).summary  # as if the attempt had been killed
        assert resumed.seconds > read.summary.seconds


@pytest.mark.slow
def test_a_trial_that_ended_touches_no_hardware(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor a file, be the folder somebody's who may only read it."""
    before = {file: file.stat().st_mtime_ns for file in TrialFolder(whole[0]).files()}
    study, log = counted(short)
    monkeypatch.setattr("simbias.trial.disk.FileLock", None)
    assert_equal(run_trial(study, whole[0]), whole[1])
    assert_equal(read_trial(study, whole[0]), whole[1])
    assert log == []
    assert {file: file.stat().st_mtime_ns for file in TrialFolder(whole[0]).files()} == before


@pytest.mark.slow
def test_a_trial_that_was_killed_is_read_as_far_as_it_goes(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by somebody who may not write."""
    monkeypatch.setattr("simbias.trial.disk.FileLock", None)
    names = step_names(whole[0])
    for lost in range(len(names) + 1):
        folder, left = cut(whole[0], tmp_path / str(lost), lost), names[: len(names) - lost]
        with FileLock(folder / LOCK) if lost % 2 else nullcontext():
            record = read_trial(short, folder)
        summary = record.summary
        assert summary.outcome is (Outcome.RUNNING if lost % 2 else Outcome.INTERRUPTED)
        assert summary.seconds == sum(sum(each.seconds.values()) for each in record.iterations)
        assert isnan(summary.ended)
        assert_equal(record.iterations, whole[1].iterations[: left.count("iteration")])
        experiments = left.count("experiment")
        assert record.summary.experiments == experiments
        assert len(record.unfinished) == experiments - 2 * len(record.iterations)


def test_its_study_is_built_from_the_folder_too(own: Whole, tmp_path: Path) -> None:
    folder, record = own
    read, study = read_folder(folder, OWN_CONF), record.study
    assert_equal(read, record)
    experiments = [made for each in (read, record) for step in each.iterations for made in step.experiments]
    assert not any(array.flags.writeable for made in experiments for array in (made.states, made.inputs))
    assert (read.study.hash, read.study.title, read.study.seed) == (study.hash, study.title, study.seed)
    assert "tracking" not in TrialFolder(folder).description()["config"]  # may hold a password
    with pytest.raises(ConfigError, match=r"point_mass"):
        read_folder(folder)  # an untrusted module is not imported
    file = Path(shutil.copytree(folder, tmp_path / "trial"), TRIAL)
    file.write_text(file.read_text().replace('"horizon": 50', '"horizon": 52'))  # one bit
    with one_line(rf"trial\.json: its config is that of trial \w+, not of {study.hash}: "):
        read_folder(file.parent, OWN_CONF)


@pytest.mark.slow
def test_what_cannot_be_read_is_one_line_that_names_the_file(
    short: Study, whole: Whole, tmp_path: Path
) -> None:
    """Run again, a trial that ended says the same as read; only its outcome is made from its steps."""
    folder, (iteration, *_, episode) = tmp_path / "trial", TrialFolder(whole[0]).steps()[11:]
    shutil.copytree(whole[0], folder)
    for name in (TRIAL, OUTCOME, "0000_search.json", "0001_experiment.npz", "0003_iteration.json"):
        right = (folder / name).read_bytes()
        for content in (b"", b"{}", b"PK"):
            (folder / name).write_bytes(content)
            foreign = name.endswith("npz") and content != b"PK"
            problem = f"{name}: {'is no npz file' if foreign else 'cannot be read'}"
            with one_line(problem):
                read_folder(folder)
            if name not in (TRIAL, OUTCOME):
                with one_line(problem):
                    run_trial(short, folder)
        (folder / name).write_bytes(right)
    outcome = json.loads(right := (folder / OUTCOME).read_bytes())
    for name, words in (("experiments", "9 experiments and 3 iterations"), ("iterations", "6 .* and 9 it.*")):
        (folder / OUTCOME).write_text(json.dumps(outcome | {name: 9}))
        for read in (read_folder, partial(run_trial, short)):
            with one_line(rf"outcome\.json: counts {words}, its steps 6 and 3\. Delete it"):
                read(folder)
    (folder / OUTCOME).unlink()
    assert_equal(timeless(run_trial(short, folder)), timeless(whole[1]))
    (folder / OUTCOME).write_bytes(right)
    for file in (episode, *TrialFolder(folder).steps()[12:-1], iteration):
        (folder / file.name).unlink()
        for read in (read_folder, partial(run_trial, short)):
            with one_line(f"/{file.name}: is missing. Put it back"):
                read(folder)
    (folder / TRIAL).unlink()
    with one_line(r"trial\.json: is missing\. Put it back"):
        run_trial(short, folder)
    assert not list(folder.glob("error_*"))
    with pytest.raises(ConfigError, match=r"is not the folder of a trial \(it has no trial\.json\)"):
        read_folder(tmp_path)


@pytest.mark.parametrize("line", [{"stopped": 3}, {"stopped": {}}, {"withdrawn": 3}, {"withdrawn": {}}])
def test_an_attempt_that_cannot_be_read_is_named(tmp_path: Path, line: dict[str, object]) -> None:
    """How one stopped follows from the steps, what was withdrawn does not."""
    (tmp_path / ATTEMPTS).write_text(json.dumps(line))
    folder = TrialFolder(tmp_path)
    with one_line(r"attempts\.jsonl: cannot be read"):
        folder.summary()
    if "stopped" in line:
        assert (folder.ended, folder.seconds()) == (False, 0.0)


def test_a_copy_under_the_hash_of_another_trial_is_not_taken_for_it(
    short: Study, whole: Whole, tmp_path: Path
) -> None:
    """Ended or not."""
    other = simbias.load([*SHORT, "seed=9"])
    copies = shutil.copytree(whole[0], tmp_path / "ended"), cut(whole[0], tmp_path / "killed", 3)
    for folder in copies:
        with one_line(rf"{folder.name}: is the folder of trial {short.hash}, not of trial {other.hash}\."):
            run_trial(other, folder)


def test_files_of_ones_own_are_no_steps(tmp_path: Path) -> None:
    """Whatever they begin with."""
    names = ["0000_search.json", "10001_experiment.npz"]
    for name in (*names, "2026-11-27_notes.txt", "1_my_plot.png", "0001_search.json.part"):
        (tmp_path / name).touch()
    assert [file.name for file in TrialFolder(tmp_path).all_steps()] == names


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["*", TRIAL, "0000_search.json", None])
def test_a_folder_that_is_changed_while_its_trial_runs_stops_it(
    short: Study, whole: Whole, tmp_path: Path, gone: str | None
) -> None:
    """Before the next experiment; put back, the trial goes on where it stopped."""
    folder, elsewhere = tmp_path / "trial", tmp_path / "elsewhere"
    study, log = counted(short)

    class Changing(Observer):
        def experimented(self, rollout: Rollout) -> None:
            if gone is None:
                folder.rename(elsewhere)
                return
            shutil.copytree(folder, elsewhere)
            for file in folder.glob(gone):
                file.unlink()
            left.extend(folder.iterdir())

    left: list[Path] = []
    with one_line(rf"^{re.escape(str(folder))}: was emptied, moved or changed .* Restore it"):
        run_trial(study, folder, Changing())
    assert log.count("made") == 1
    assert [*folder.glob("*")] == left
    shutil.copytree(elsewhere, folder, dirs_exist_ok=True)
    assert_equal(timeless(run_trial(study, folder)), timeless(whole[1]))
    assert log.count("made") == EXPERIMENTS


def test_a_folder_that_is_moved_during_an_experiment_is_one_line(short: Study, tmp_path: Path) -> None:
    """Also where the hardware raises then; an interruption remains one."""
    folder = tmp_path / "trial"

    class Moving(Hardware):
        def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
            folder.rename(tmp_path / raised.__name__)
            raise raised

    for raised in (OSError, KeyboardInterrupt):
        expected, words = (ConfigError, "Restore it") if raised is OSError else (raised, None)
        with one_line(words, expected):
            run_trial(replace(short, hardware=Moving()), folder)
        assert not folder.exists()


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="devices and pipes")
def test_a_device_or_a_pipe_is_not_read_for_ever(short: Study, whole: Whole, tmp_path: Path) -> None:
    for name in (ATTEMPTS, "0000_search.json", "0001_experiment.npz"):
        folder = shutil.copytree(whole[0], tmp_path / name)
        for kind in (os.mkfifo, lambda file: file.symlink_to("/dev/zero")):
            (folder / name).unlink()
            kind(folder / name)
            with pytest.raises(ConfigError, match=rf"{re.escape(name)}: is not a regular file"):
                read_trial(short, folder)


def test_an_experiment_that_no_hardware_can_have_made_is_named(
    short: Study, whole: Whole, tmp_path: Path
) -> None:
    """Arrays of another shape, of no numbers, or of NaN, as somebody's own script writes them."""
    file = shutil.copytree(whole[0], tmp_path / "trial") / "0001_experiment.npz"
    with np.load(file) as archive:
        arrays = dict(archive)
    for name in ("states", "inputs", "measured", "sensed"):
        right = np.atleast_1d(arrays.get(name, arrays["states"])).astype(float)
        for wrong in (right[:-1], np.full_like(right, np.nan), right.astype(str)):
            np.savez(file, **{**arrays, name: wrong})
            with one_line(r"0001_experiment\.npz: cannot be read"):
                read_trial(short, file.parent)


def test_an_experiment_that_holds_objects_runs_nothing(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple:
            return Path.touch, (tmp_path / "ran",)

    names = ("states", "inputs", "parameters")
    np.savez(tmp_path / "evil.npz", **{name: np.array([Evil()], dtype=object) for name in names})
    with pytest.raises(ValueError, match="allow_pickle"):
        load_rollout(tmp_path / "evil.npz")
    assert not (tmp_path / "ran").exists()


def test_steps_of_other_code_are_one_line(short: Study, whole: Whole, tmp_path: Path) -> None:
    """Another kind of step, another policy, another experiment with the same policy, another iteration."""
    folders = [cut(whole[0], tmp_path / name, 0) for name in ("kind", "theta", "place", "iteration")]
    kind, theta, place, iteration = folders
    (kind / "0000_search.json").rename(kind / "0000_experiment.npz")
    shutil.copy(place / "0001_experiment.npz", place / "0002_experiment.npz")
    for file, change in (
        (theta / "0000_search.json", {"parameters": [0.0] * 5}),
        (iteration / "0003_iteration.json", {"succeeded": True}),
    ):
        file.write_text(json.dumps(json.loads(file.read_text()) | change))
    names = ("0000_experiment.npz", "0001_experiment.npz", "0002_experiment.npz", "0003_iteration.json")
    for folder, file in zip(folders, names, strict=True):
        message = f"{file}: does not fit the trial: its code, a file that it reads or this folder has changed"
        with pytest.raises(ConfigError, match=message):
            read_trial(short, folder)
        record = run_trial(short, folder)
        assert (record.outcome, message in record.summary.reason) == (Outcome.ERROR, True)
        assert step_names(folder)[1:] == step_names(whole[0])[1:]  # nothing is lost
    (theta / "0000_search.json").unlink()
    with pytest.raises(
        ConfigError, match=r"0001_experiment\.npz: does not fit the trial: step 0000 is missing\. Put it back"
    ):
        read_trial(short, theta)


def test_changed_code_is_said_and_changes_no_prediction(
    own: Whole, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, study = shutil.copytree(own[0], tmp_path / "trial"), own[1].study
    assert changed_since(study, folder) == ""
    description = json.loads((folder / TRIAL).read_text())
    assert description["code"]
    (folder / TRIAL).write_text(json.dumps(description | {"code": {"point_mass": "another"}}))
    said = "is shown as it was; its code or files have changed since it began (point_mass)"
    assert said in changed_since(study, folder)
    assert [read_folder(each, OWN_CONF).changed_code for each in (own[0], folder)] == ["", "point_mass"]
    (line,) = (each.getMessage() for each in caplog.records)
    assert "its code or files have changed since it began (point_mass)" in line
    file = next(folder.glob("*_iteration.json"))
    file.write_text(json.dumps(json.loads(file.read_text()) | {"predicted_cost": 38.9}))
    for record in (run_trial(study, folder), read_trial(study, folder)):
        assert 38.9 in {each.search.predicted_cost for each in record.iterations if each.search}
    (folder / OUTCOME).unlink()
    assert "resumes, but its code or files have changed" in changed_since(study, folder)
    run_trial(study, folder)
    assert TrialFolder(folder).attempts()[-1]["code"] == description["code"]
    (folder / TRIAL).write_text(json.dumps(description))  # as if the change had been made later, and undone
    (digest,) = description["code"].values()
    (folder / ATTEMPTS).write_text((folder / ATTEMPTS).read_text().replace(digest, "another"))
    assert said in changed_since(study, folder)
    assert changed_since(study, tmp_path / "none") == ""


@pytest.mark.slow
def test_another_platform_is_said_and_kept(
    short: Study,
    whole: Whole,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    here = platform.kind()
    begun, unbegun = cut(whole[0], tmp_path / "begun", 3), cut(whole[0], tmp_path / "unbegun", 14)
    monkeypatch.setattr(platform, "kind", lambda: "another")
    with caplog.at_level(logging.WARNING):
        records = [run_trial(short, folder) for folder in (begun, unbegun)]
    (warning,) = [each.getMessage() for each in caplog.records]
    assert warning.endswith(
        f"trial begun mixes platforms, so its last bits match neither: {here}; now another"
    )
    assert [record.summary.platforms for record in records] == 2 * [(here, "another")]


@pytest.mark.slow
def test_a_full_disk_loses_nothing(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Full at any step, the trial stops with an error, and resumes, time and again, as uninterrupted."""

    def until_full(path: Path, content: bytes) -> None:
        if path.name[0].isdigit() and len(step_names(tmp_path)) >= room:
            raise OSError(28, "No space left on device")
        write_whole(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(step_files, "write_whole", until_full)
        for room in range(len(step_names(whole[0]))):
            record = run_trial(short, tmp_path)
            assert (record.outcome, len(step_names(tmp_path))) == (Outcome.ERROR, room)
            assert "No space left on device" in record.summary.reason
    assert_equal(timeless(run_trial(short, tmp_path)), timeless(whole[1]))


def test_no_experiment_is_made_that_could_not_be_kept(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where files may not grow to its size, as on a full disk, the hardware is not asked."""
    (study, log), limits = counted(short), resource.getrlimit(resource.RLIMIT_FSIZE)
    kept = min(file.stat().st_size for file in whole[0].glob("*_experiment.npz"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (kept // 2, limits[1]))
    try:
        record = run_trial(study, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    reason = f"OSError: [Errno 27] File too large: {str(tmp_path)!r}"
    assert (record.outcome, record.summary.reason) == (Outcome.ERROR, reason)
    assert log == []
    assert not list(tmp_path.glob("*_experiment*"))
    spare = []

    def write(path: Path, content: bytes) -> None:
        if path.name.endswith((EXPERIMENT, EPISODE)):
            spare.append(path.with_name(f"{path.name}{PART}").stat().st_size - len(content))
        write_whole(path, content)

    monkeypatch.setattr(step_files, "write_whole", write)
    assert_equal(timeless(run_trial(study, tmp_path)), timeless(whole[1]))
    assert log.count("made") == len(spare) == EXPERIMENTS
    assert min(spare) >= 0


def test_a_folder_that_cannot_be_written_is_one_line(
    short: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a file is there in whole, or as it was."""

    def fail(file: int) -> None:
        raise OSError(28, "disk full")

    path = tmp_path / "file"
    write_whole(path, b"old")
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", fail)
        with pytest.raises(OSError, match=f"disk full: {str(tmp_path)!r}"):
            write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    with pytest.raises(ConfigError, match=r"file.*cannot be written"):
        run_trial(short, path / "trial")
    (tmp_path / "link").symlink_to("missing")
    with pytest.raises(ConfigError, match=r"link: is no folder, or a link to a missing one$"):
        run_trial(short, tmp_path / "link" / "trial")


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.EINVAL, errno.EIO])
def test_a_folder_that_cannot_be_synchronised_loses_nothing(
    short: Study, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Where its file system cannot, the trial goes on; any other error ends it in one line that names it."""
    (study, log), synchronise = counted(short), os.fsync

    def fail(file: int) -> None:
        if stat.S_ISDIR(os.fstat(file).st_mode) and step_names(tmp_path):
            raise OSError(number, os.strerror(number))
        synchronise(file)

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", fail)
        record, steps = run_trial(study, tmp_path), step_names(tmp_path)
    if number == errno.EIO:
        assert (record.outcome, steps) == (Outcome.ERROR, ["search"])
        assert record.summary.reason == f"OSError: [Errno 5] Input/output error: {str(tmp_path)!r}"
        record = run_trial(study, tmp_path)
    assert_equal(timeless(record), timeless(whole[1]))
    assert log.count("made") == EXPERIMENTS


def test_pandas_reads_it(whole: Whole) -> None:
    folder = TrialFolder(whole[0])
    iterations = pd.json_normalize(folder.iterations())
    assert list(iterations["iteration"]) == [0, 1, 2]
    assert list(iterations["hardware_cost"]) == [each.hardware_cost for each in whole[1].iterations]
    assert list(iterations["metrics.experiments/total"]) == [2.0, 4.0, 6.0]
    assert (iterations["seconds.search"] > 0).all()
    attempts = pd.read_json(StringIO((whole[0] / ATTEMPTS).read_text()), lines=True)
    assert list(attempts["platform"]) == [platform.kind()]
    (outcome,) = pd.json_normalize(json.loads((whole[0] / OUTCOME).read_text())).to_dict("records")
    assert (outcome["outcome"], outcome["experiments"]) == ("not succeeded", 6)
    assert len(pd.read_csv(whole[0] / EPISODES)) == 2
    with np.load(whole[0] / "0001_experiment.npz", allow_pickle=False) as file:
        fields = set(file.files)
    assert fields == {"states", "inputs", "parameters", "measured", "sensed", "place"}  # all have values


@pytest.mark.slow
def test_any_method_runs_resumes_and_is_read_back(point_mass: Study, tmp_path: Path) -> None:
    method = Guessing()
    method.succeeds = True
    study = replace(point_mass, method=method)
    uninterrupted = run_trial(study, tmp_path / "whole")
    assert (uninterrupted.outcome, uninterrupted.summary.experiments) == (Outcome.SUCCEEDED, 4)
    assert_equal(read_trial(study, tmp_path / "whole"), uninterrupted)
    for lost in range(len(step_names(tmp_path / "whole")) + 1):
        folder = tmp_path / str(lost)
        shutil.copytree(tmp_path / "whole", folder)
        (folder / OUTCOME).unlink()
        for file in TrialFolder(folder).steps()[6 - lost :]:
            file.unlink()
        assert_equal(timeless(run_trial(study, folder)), timeless(uninterrupted))
