"""Stores that are made, shared, or cannot be used: one quick line that names the store."""

import logging
import multiprocessing
import os
import shutil
import socket
import sqlite3
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
from errors import one_line
from mlflow import MlflowClient
from processes import wait_for

from simbias.config import ConfigError
from simbias.core.messages import redact
from simbias.mlflow import store, ui
from simbias.mlflow.tracking import Mlflow

pytestmark = pytest.mark.slow


def uri(folder: Path) -> str:
    return f"sqlite:///{folder}/mlflow.db"


@pytest.mark.usefixtures("new_store")  # so that all has been imported that forks need
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of forks
def test_processes_make_a_new_store_at_once_and_share_it(tmp_path: Path) -> None:
    """Also after one was killed while it made the store."""
    context = multiprocessing.get_context("fork")

    def start() -> BaseProcess:
        process = context.Process(target=store.connect, args=(uri(tmp_path), "mine"))
        process.start()
        return process

    killed = start()
    wait_for((tmp_path / ".mlflow.db.lock").exists)
    killed.kill()
    (tmp_path / ".mlflow.db.part").write_text("half")
    started = [start() for _ in range(2)]
    for process in started:
        process.join(120)
        assert process.exitcode == 0
    experiments = MlflowClient(uri(tmp_path)).search_experiments()
    assert sorted(each.name for each in experiments) == ["Default", "mine"]
    assert {file.name for file in tmp_path.iterdir()} == {"mlflow.db", ".mlflow.db.lock"}


def test_its_files_lie_beside_it(
    new_store: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Quietly, whatever the folder's name, and nothing of the user's MLflow is touched."""
    monkeypatch.delenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", raising=False)
    folder /= "a%41?ü #"
    folder.mkdir()
    monkeypatch.chdir(folder)
    shutil.copy(new_store, folder)
    level = logging.getLogger("mlflow").level
    client, experiment_id = store.connect("sqlite:///mlflow.db", "mine")
    assert client.get_experiment(experiment_id).artifact_location == (folder / "mlartifacts").as_uri()
    assert [*folder.parent.iterdir()] == [folder]
    assert Mlflow().folder == folder / "trials"
    assert Mlflow(trials="elsewhere").folder == Path("elsewhere")
    assert (logging.getLogger("mlflow").level, capfd.readouterr()) == (level, ("", ""))
    assert "MLFLOW_HTTP_REQUEST_MAX_RETRIES" not in os.environ


def test_a_database_on_a_server_says_where_files_go(
    new_store: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once: when the experiment is made, or on a machine that does not have the folder."""
    shutil.copy(new_store, folder)
    monkeypatch.setattr(store, "DATABASE_SERVERS", ("sqlite",))
    monkeypatch.setattr(store, "database", lambda _: None)
    for _ in range(2):
        client, experiment_id = store.connect(uri(folder), "mine")
        client.log_text(client.create_run(experiment_id).info.run_id, "", "file")
    (line,) = [each.getMessage() for each in caplog.records]
    assert f"files of runs go to {folder}/mlruns/{experiment_id} on this machine" in line


def unusable(folder: Path, new_store: Path) -> Iterator[tuple[str, str]]:
    """Addresses and what is said of them."""
    (folder / "text").write_text("no database " * 100)
    (folder / "circle").symlink_to("circle")
    (folder / "taken").mkdir()
    (folder / "taken" / "mlartifacts").touch()
    for name, statement in {
        "other": "CREATE TABLE mine (value)",
        "newer": "UPDATE alembic_version SET version_num = 'ffffffffffff'",
    }.items():
        if name == "newer":
            shutil.copy(new_store, folder / name)
        with closing(sqlite3.connect(folder / name)) as database:
            database.execute(statement)
            database.commit()
    yield f"sqlite:///{folder}/missing/mlflow.db", "no folder"
    yield f"sqlite:///{folder}/text", "file is not a database"
    yield f"sqlite:///{folder}/circle", "Too many levels of symbolic links"
    yield f"sqlite:///{folder}/taken/mlflow.db", "must be a folder, for its files"
    yield f"sqlite:///{folder}/other", "the database of another program"
    yield f"sqlite:///{folder}/newer", "of another version of MLflow"
    yield f"sqlite:///{folder}", "unable to open database file"
    yield "sqlite://", "in memory"
    yield "sqlite:///:memory:", "in memory"
    yield (
        str(folder),
        "MLflow no longer uses folders as stores; use sqlite:///FILE or ",
    )
    yield "foo://bar", "unsupported URI"
    yield "http://127.0.0.1:9", "refused"
    yield "http://me:secret@no-such-host.invalid", ""
    yield "postgresql://me:secret@127.0.0.1:9/x", ""


def test_a_store_that_cannot_be_used_is_one_quick_line_that_names_it(tmp_path: Path, new_store: Path) -> None:
    for address, message in unusable(tmp_path, new_store):
        start = time.perf_counter()
        with one_line() as caught:
            store.connect(address, "mine")
        assert time.perf_counter() - start < 10
        assert caught.value.key == "tracking.uri"
        assert message in caught.value.problem
        assert "secret" not in str(caught.value)
    assert (tmp_path / "text").read_text() == "no database " * 100
    with closing(sqlite3.connect(tmp_path / "other")) as database:
        assert database.execute("SELECT name FROM sqlite_master").fetchall() == [("mine",)]


def test_a_user_without_a_home_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without one, MLflow cannot be imported."""
    (tmp_path / "mlflow.py").write_text("raise RuntimeError('Could not determine home directory.')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mlflow")
    with one_line(r"tracking\.uri: sqlite:///mlflow\.db: MLflow needs a home directory; set HOME"):
        store.connect("sqlite:///mlflow.db", "mine")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_store_that_may_not_be_written(tmp_path: Path, new_store: Path) -> None:
    shutil.copy(new_store, tmp_path)
    (tmp_path / "mlflow.db").chmod(0o400)
    tmp_path.chmod(0o500)
    for name in ("mlflow.db", "new.db"):
        with pytest.raises(ConfigError, match=r"tracking\.uri: .*readonly database|cannot be written"):
            store.connect(f"sqlite:///{tmp_path}/{name}", "mine")
    tmp_path.chmod(0o700)


def test_a_deleted_experiment_and_what_is_no_name_are_named(tmp_path: Path, new_store: Path) -> None:
    shutil.copy(new_store, tmp_path)
    client, experiment_id = store.connect(uri(tmp_path), "mine")
    client.delete_experiment(experiment_id)
    with pytest.raises(ConfigError, match=r"tracking\.experiment: mine is deleted"):
        store.connect(uri(tmp_path), "mine")
    for name in ("", "..", " .", "a\nb", "\x1b[31m"):
        with pytest.raises(ValueError, match=r"^experiment must be a name"):
            Mlflow(experiment=name)


def test_a_server_that_says_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        start = time.perf_counter()
        with pytest.raises(ConfigError, match=r"tracking\.uri: http://127\.0\.0\.1.*timed out"):
            store.connect(f"http://127.0.0.1:{silent.getsockname()[1]}", "mine")
        assert time.perf_counter() - start < 10


def test_the_ui_reaches_a_server_before_it_names_a_page() -> None:
    with one_line(r"^tracking\.uri: http://127\.0\.0\.1:9: .*refused"):
        Mlflow(uri="http://127.0.0.1:9").show(None, None)


def test_no_password_is_shown() -> None:
    for text, expected in {
        "http://me:secret@host:5000/path": "http://host:5000/path",
        "postgresql+psycopg2://me:se/cr@et@host/x is away": "postgresql+psycopg2://host/x is away",
        "sqlite:////a/b@c/mlflow.db": "sqlite:////a/b@c/mlflow.db",
        "sqlite:///mlflow.db": "sqlite:///mlflow.db",
    }.items():
        assert redact(text) == expected
    for address, secret in {
        "http://me:se cr@et@host:5000": "se cr@et",
        "postgresql://me:%73e%40cret@host/x": "se@cret",
        "mysql+pymysql://host/x?user=me&password=se%20cret&ssl=1": "se%20cret",
        "https://a-long-token@host": "a-long-token",
        "http://me:secr#et@host": "secr",
    }.items():
        said = redact(f"no answer from {address}: wrong password {secret}", address)
        assert said.startswith("no answer from ")
        assert "host" in said
        assert secret not in said
        assert "%73e" not in said


def test_a_servers_page_is_opened_and_its_address_shown_without_a_password(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("webbrowser.open", opened.append)
    ui.show("https://me:secret12@a.b", "#/x")
    assert opened == ["https://me:secret12@a.b/#/x"]
    assert capsys.readouterr().out == "https://a.b/#/x  (Ctrl-C stops a local server)\n"


def test_a_port_that_is_taken_or_none_is_named() -> None:
    """In place of what another program shows there."""
    for none in (0, -1, 70000):
        with one_line(f"^--port: expected 1 to 65535, got {none}"):
            ui.show("sqlite:///mlflow.db", "", none)
    with socket.create_server((ui.HOST, 0)) as other:
        port = other.getsockname()[1]
        with one_line(f"^--port: {port} is taken; "):
            ui.show("sqlite:///mlflow.db", "", port)
