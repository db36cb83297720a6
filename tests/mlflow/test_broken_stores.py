"""Stores that somebody changed: what can be used is used, and what cannot is one line that names it."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from sweeping import QUICK, write_sweep

from simbias.__main__ import main
from simbias.mlflow import rows

pytestmark = pytest.mark.slow

SHORT = [*QUICK, "tracking.pictures=false"]
TRIAL = [*SHORT, "seed=1"]
SWEEP = ["+sweep=smoke", "sweep.trials=1", "engine=sequential", *SHORT]
CHILD = "(SELECT run_uuid FROM tags WHERE key = 'mlflow.parentRunId' ORDER BY 1 LIMIT 1)"


def uri(folder: Path) -> str:
    return f"tracking.uri=sqlite:///{folder}/mlflow.db"


def change(folder: Path, *statements: str) -> None:
    with closing(sqlite3.connect(folder / "mlflow.db")) as database:
        for statement in statements:
            database.execute(statement)
        database.commit()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a trial and a sweep of two."""
    folder = tmp_path_factory.mktemp("good")
    assert main([*TRIAL, uri(folder)]) in (0, 1)
    assert main([*SWEEP, uri(folder)]) == 0
    return folder


@pytest.fixture
def store(good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same in a folder of its own."""
    folder = tmp_path / "store"
    shutil.copytree(good, folder)
    moved = [("experiments", "artifact_location"), ("runs", "artifact_uri")]
    change(folder, *(f"UPDATE {t} SET {c} = replace({c}, '{good}', '{folder}')" for t, c in moved))
    monkeypatch.chdir(folder)
    rows._tell.cache_clear()
    return folder


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize(
    ("statement", "lacking"),
    [
        (f"DELETE FROM tags WHERE key = 'hash' AND run_uuid = {CHILD}", "tag hash"),
        (f"DELETE FROM tags WHERE key = 'outcome' AND run_uuid = {CHILD}", "tag outcome"),
        (f"UPDATE tags SET value = 'fine' WHERE key = 'outcome' AND run_uuid = {CHILD}", "tag outcome"),
        (f"UPDATE runs SET end_time = NULL WHERE run_uuid = {CHILD}", "end"),
        (
            f"DELETE FROM latest_metrics WHERE key = 'trial/seconds' AND run_uuid = {CHILD}",
            "metric trial/seconds",
        ),
    ],
)
def test_a_row_that_lacks_something_is_named_and_its_trial_run_again(
    store: Path,
    statement: str,
    lacking: str,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with closing(sqlite3.connect(store / "mlflow.db")) as database:
        ((run_id,),) = database.execute(f"SELECT {CHILD}").fetchall()
    change(store, statement)
    assert main([*SWEEP, "sweep.dry_run=true", uri(store)]) == 0
    assert "1 of 2 trials are finished" in capsys.readouterr().out
    assert main([*SWEEP, uri(store)]) == 0
    (warning,) = warnings(caplog)
    assert warning.startswith(f"simbias: run {run_id} lacks its {lacking}, ")
    assert "1 of them finished already" in capsys.readouterr().out
    assert main([*SWEEP, "sweep.dry_run=true", uri(store)]) == 0
    assert "2 of 2 trials are finished" in capsys.readouterr().out


def test_a_trial_that_lacks_something_goes_on(store: Path, caplog: pytest.LogCaptureFixture) -> None:
    change(store, "DELETE FROM tags WHERE key = 'outcome'")
    assert main([*TRIAL, uri(store)]) in (0, 1)
    (warning,) = warnings(caplog)
    assert "lacks its tag outcome" in warning
    assert main([*TRIAL, uri(store)]) in (0, 1)
    assert len(warnings(caplog)) == 1


def test_the_journal_of_a_trial_that_is_kept_goes(store: Path) -> None:
    """Its process was killed between keeping the trial and removing the journal."""
    with closing(sqlite3.connect(store / "mlflow.db")) as database:
        query = f"SELECT value FROM tags WHERE key = 'hash' AND run_uuid = {CHILD}"
        ((identity,),) = database.execute(query).fetchall()
    journal = store / "journals" / "simbias" / identity
    journal.mkdir(parents=True)
    (journal / "0000_search.json").write_text("{}")
    assert main([*SWEEP, uri(store)]) == 0
    assert not (store / "journals").exists()


def file_in_place_of(pattern: str) -> Callable[[Path], None]:
    """Put a file where a folder was."""

    def replace(store: Path) -> None:
        for path in list(store.glob(pattern)):
            shutil.rmtree(path)
            path.write_text("no folder")

    return replace


def circle(store: Path) -> None:
    """A link to itself."""
    (store / "mlflow.db").unlink()
    (store / "mlflow.db").symlink_to("mlflow.db")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda store: change(store, "DROP TABLE metrics"), "lacks the tables metrics"),
        (lambda store: change(store, "DROP TABLE runs"), "lacks the tables runs"),
        (
            lambda store: change(store, "UPDATE alembic_version SET version_num = '451aebb31d03'"),
            "of another version of MLflow",
        ),
        (
            lambda store: change(store, "UPDATE alembic_version SET version_num = 'ffffffffffff'"),
            "of another version of MLflow",
        ),
        (lambda store: (store / "mlflow.db").write_text(1000 * "hello "), "file is not a database"),
        (circle, "Too many levels of symbolic links"),
        (file_in_place_of("mlartifacts"), "mlartifacts is in the place of the folder for its files"),
    ],
)
def test_a_store_that_cannot_be_used_is_named(
    store: Path, damage: Callable[[Path], object], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    damage(store)
    for command in (TRIAL, SWEEP, [*SWEEP, "sweep.dry_run=true"]):
        assert main([*command, uri(store)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("simbias: tracking.uri: ")
        assert f"{store}/mlflow.db" in line
        assert words in line


@pytest.mark.parametrize(
    "damage",
    [
        lambda store: change(store, "DELETE FROM metrics"),
        lambda store: shutil.rmtree(store / "mlartifacts"),
        file_in_place_of("mlartifacts/*"),
    ],
)
def test_a_finished_trial_that_cannot_be_read_is_named(
    store: Path, damage: Callable[[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    damage(store)
    assert main([*TRIAL, uri(store)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "its files cannot be read" in line or "its iterations are not in the store" in line


def test_a_sweep_may_have_quotes_in_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    conf = write_sweep(tmp_path, "o'brien's \"own\"", "sweep: {trials: 1, axes: {}}")
    command = ["--config-dir", str(conf), "+sweep='o\\'brien\\'s \"own\"'", "engine=sequential", *SHORT]
    for _ in range(2):
        assert main([*command, uri(tmp_path)]) == 0
    assert "1 of them finished already" in capsys.readouterr().out
