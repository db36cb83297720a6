"""Folders and stores that somebody moves: what is written stays in one place, or nothing is."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from simbias.config import ConfigError
from simbias.core.records import Iteration
from simbias.mlflow.tracking import Mlflow
from simbias.trial.folder import TrialFolder
from simbias.trial.observer import Observer, Observers
from simbias.trial.run import run_trial
from simbias.trial.study import Study

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("uncompiled")]

FILES = ("mlflow.db", "mlartifacts", "trials")


def move(here: Path, there: Path, names: tuple[str, ...] = FILES) -> None:
    for name in names:
        (here / name).rename(there / name)


class Moving(Observer):
    """Moves files after the first iteration."""

    def __init__(self, *files: Any) -> None:
        self._files = files

    def iterated(self, iteration: Iteration) -> None:
        if iteration.index == 0:
            move(*self._files)


@pytest.fixture
def folder(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a new store, and another one beside it."""
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
    shutil.copy(new_store, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def left(folder: Path) -> set[str]:
    """The names of files, hidden ones left out."""
    return {file.name for file in folder.iterdir() if not file.name.startswith(".")}


def test_a_store_that_is_moved_while_a_trial_runs_is_left_alone(
    folder: Path, hasty: Study, caplog: pytest.LogCaptureFixture
) -> None:
    """The trial goes on; no other store is begun in its place."""
    store, trial = Mlflow(), folder / "trials" / hasty.hash
    shown, moving = store.export_trial(trial), Moving(folder, folder.parent / "there", FILES[:2])
    record = run_trial(hasty, trial, Observers(shown, moving))
    shown.update(final=True)
    assert (record.outcome.final, len(record.iterations) > 1) == (True, True)
    assert left(folder) == {"trials"}
    (warning,) = [each.getMessage() for each in caplog.records]
    assert "tracking.uri: sqlite:///mlflow.db: the store was moved or replaced. All" in warning


def test_a_working_folder_that_is_moved_takes_the_trial_along(
    folder: Path, hasty: Study, caplog: pytest.LogCaptureFixture
) -> None:
    """What is relative follows; the store, whose files have absolute addresses, is left alone."""
    store, trial = Mlflow(trials="trials"), Path("trials") / hasty.hash
    shown, moving = store.export_trial(trial), Moving(folder.parent, folder.parent / "there", ("here",))
    assert run_trial(hasty, trial, Observers(shown, moving)).outcome.final
    shown.update(final=True)
    assert not folder.exists()
    assert TrialFolder(folder.parent / "there" / "here" / trial).ended
    assert len(caplog.records) == 1


def test_a_store_that_was_moved_is_one_line(folder: Path, new_store: Path, hasty: Study) -> None:
    """MLflow keeps absolute addresses; from the trials it is made again."""
    trial, there = folder / "trials" / hasty.hash, folder.parent / "there"
    run_trial(hasty, trial)
    list(Mlflow().export())
    move(folder, there)
    moved = Mlflow(f"sqlite:///{there}/mlflow.db")
    copied = r"^tracking\.uri: was moved or copied: its files are in file:.*here"
    with pytest.raises(ConfigError, match=copied):
        list(moved.export())
    assert left(folder) == set()
    shutil.copy(new_store, there / "another.db")
    assert list(Mlflow(f"sqlite:///{there}/another.db").export()) == ["1 trial in no sweep"]
