"""Folders and stores that somebody moves: what is written stays in one place, or nothing is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from conftest import OWN_CONF, POINT_MASS
from sweeping import write_sweep

import simbias
from simbias.config import ConfigError
from simbias.core.records import Iteration
from simbias.mlflow.tracking import Mlflow
from simbias.sweep.grid import Trial
from simbias.sweep.running import SweepObserver
from simbias.sweep.worker import Result
from simbias.trial.folder import TrialFolder
from simbias.trial.observer import Observer, Observers
from simbias.trial.run import run_trial
from simbias.trial.study import Study

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("uncompiled")]

FILES = ("mlflow.db", "mlartifacts", "trials")


class Moving(Observer):
    """Moves files after the first iteration."""

    def __init__(self, here: Path, there: Path, names: tuple[str, ...]) -> None:
        self._here, self._there, self._names = here, there, names

    def iterated(self, iteration: Iteration) -> None:
        for name in self._names if iteration.index == 0 else ():
            (self._here / name).rename(self._there / name)


@pytest.fixture
def folder(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a new store, and another one beside it."""
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    shutil.copy(new_store, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.fixture
def study() -> Study:
    changes = ["tracking=none", "optimizer.max_evaluations=20", "method.max_iterations=3"]
    return simbias.load([*POINT_MASS, *changes], OWN_CONF)


def left(folder: Path) -> set[str]:
    """The names of files, hidden ones left out."""
    return {file.name for file in folder.iterdir() if not file.name.startswith(".")}


def test_a_store_that_is_moved_while_a_trial_runs_is_left_alone(
    folder: Path, study: Study, caplog: pytest.LogCaptureFixture
) -> None:
    """The trial goes on; no other store is begun in its place."""
    store, trial = Mlflow(), folder / "trials" / study.hash
    shown, moving = store.export_trial(trial), Moving(folder, folder.parent / "there", FILES[:2])
    record = run_trial(study, trial, Observers(shown, moving))
    shown.update(final=True)
    assert (record.outcome.final, len(record.iterations) > 1) == (True, True)
    assert left(folder) == {"trials"}
    (warning,) = [each.getMessage() for each in caplog.records]
    assert (
        "tracking.uri: sqlite:///mlflow.db: the store was moved, or another put there. All is kept" in warning
    )


def test_a_working_folder_that_is_moved_takes_the_trial_along(
    folder: Path, study: Study, caplog: pytest.LogCaptureFixture
) -> None:
    """What is relative follows; the store, whose files have absolute addresses, is left alone."""
    store, trial = Mlflow(trials="trials"), Path("trials") / study.hash
    shown, moving = store.export_trial(trial), Moving(folder.parent, folder.parent / "there", ("here",))
    assert run_trial(study, trial, Observers(shown, moving)).outcome.final
    shown.update(final=True)
    assert not folder.exists()
    assert TrialFolder(folder.parent / "there" / "here" / trial).ended
    assert len(caplog.records) == 1


def test_a_folder_that_is_moved_while_its_trial_runs_stops_it(folder: Path, study: Study) -> None:
    trial, there = folder / "trials" / study.hash, folder.parent / "there"
    with pytest.raises(FileNotFoundError):
        run_trial(study, trial, Moving(folder, there, FILES[2:]))
    assert left(folder) == {"mlflow.db"}
    moved = there / "trials" / study.hash
    assert len(TrialFolder(moved).iterations()) == 1
    assert run_trial(study, moved).outcome.final


def test_a_store_that_was_moved_is_one_line(folder: Path, study: Study) -> None:
    """MLflow keeps absolute addresses; from the trials it is made again."""
    trial, there = folder / "trials" / study.hash, folder.parent / "there"
    run_trial(study, trial)
    list(Mlflow().export_all())
    for name in FILES:
        (folder / name).rename(there / name)
    moved = Mlflow(f"sqlite:///{there}/mlflow.db")
    with pytest.raises(
        ConfigError, match=r"^tracking\.uri: was moved or copied: its files are in file:.*here"
    ):
        list(moved.export_all())
    assert left(folder) == set()
    assert list(Mlflow(f"sqlite:///{there}/another.db").export_all()) == ["1 trial in no sweep"]


class MovingTrials(SweepObserver):
    """Moves all trials after the first one."""

    def __init__(self, here: Path, there: Path) -> None:
        self._here, self._there = here, there

    def ended(self, trial: Trial, result: Result) -> None:
        if (self._here / "trials").exists():
            (self._here / "trials").rename(self._there / "trials")


def test_a_sweep_whose_trials_are_moved_writes_nothing_where_they_were(folder: Path) -> None:
    write_sweep(folder, "mine", "sweep:\n  trials: 3\n  axes:\n    bias: [none]\n")
    quick = ["task.horizon=100", "optimizer.max_evaluations=10", "method.max_iterations=1"]
    overrides = ["+sweep=mine", *quick, "engine=sequential", "tracking.pictures=false"]
    with pytest.raises(FileNotFoundError):
        simbias.run_sweep(overrides, folder / "conf", MovingTrials(folder, folder.parent / "there"))
    assert left(folder) == {"mlflow.db", "mlartifacts", "conf"}
    assert len(list((folder.parent / "there" / "trials").glob("*/outcome.json"))) == 1
