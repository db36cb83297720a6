"""A new SQLite store is a copy of one that was made before, and the same as one of MLflow's own making."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from mlflow import MlflowClient

from simbias.mlflow import store

pytestmark = pytest.mark.slow

TIMES = ("creation_time", "last_update_time")  # columns that differ


def content(file: Path) -> dict[str, list[dict]]:
    """The indices, columns and rows of a database, but for times and folders."""
    with closing(sqlite3.connect(file)) as database:
        database.row_factory = sqlite3.Row
        made = [dict(row) for row in database.execute("SELECT type, name FROM sqlite_master ORDER BY name")]
        tables = [row["name"] for row in made if row["type"] == "table"]
        columns = {name: list(map(tuple, database.execute(f"PRAGMA table_info({name})"))) for name in tables}
        rows = {name: [dict(row) for row in database.execute(f"SELECT * FROM {name}")] for name in tables}
    for row in rows["experiments"]:
        assert Path(row.pop("artifact_location")).parent.parent == file.parent
        for column in TIMES:
            assert row.pop(column) > 0
    return {"made": made, "columns": [columns], **rows}


def test_a_copy_is_as_mlflow_makes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    MlflowClient(f"sqlite:///{tmp_path}/mlflows.db").search_experiments(max_results=1)
    store._create(tmp_path / "ours.db")
    assert content(tmp_path / "ours.db") == content(tmp_path / "mlflows.db")
    assert not list(tmp_path.glob(f".*{store.PART}"))


def test_it_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "cache_folder", lambda name: tmp_path)
    first = store._empty_store()
    written = first.stat().st_mtime_ns
    assert store._empty_store() == first
    assert first.stat().st_mtime_ns == written
    assert [path.name for path in tmp_path.iterdir()] == [first.name]


def test_of_two_processes_that_make_it_at_once_the_first_does(tmp_path: Path) -> None:
    """Else what the first has kept by then would be lost."""
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    store.connect(uri, "mine")
    store._create(tmp_path / "mlflow.db")
    assert MlflowClient(uri).get_experiment_by_name("mine") is not None
    assert not list(tmp_path.glob(f".*{store.PART}"))
    (tmp_path / "empty.db").touch()
    store.connect(f"sqlite:///{tmp_path}/empty.db", "mine")


def test_what_a_kill_left_of_one_goes_with_the_next_start(tmp_path: Path) -> None:
    uri, dead = f"sqlite:///{tmp_path}/mlflow.db", tmp_path / f".mlflow.db.{2**22 + 1}{store.PART}"
    for _ in range(2):
        dead.touch()
        store.connect(uri, "mine")
        assert not dead.exists()
