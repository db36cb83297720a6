"""Reaching an MLflow store: quietly, and failing within seconds where MLflow would try for minutes."""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
import sqlite3
import textwrap
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core.cache import cache_folder
from simbias.core.errors import ConfigError

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}
OTHER_VERSION = "of another version of MLflow; update MLflow, or make a copy and run `mlflow db upgrade URI`"
TABLES = frozenset(  # that every store has; in place of those that are gone, MLflow would make useless ones
    [
        *("alembic_version", "experiments", "experiment_tags"),
        *("runs", "tags", "params", "metrics", "latest_metrics"),
    ]
)
PLAIN = re.compile(r"sqlite:///([^?%@]+)")  # an address whose file is what stands there
PART = ".part"  # suffix of a SQLite store that is being made
IMPATIENT = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}  # seconds


def redact(uri: str) -> str:
    """A URI without its user and password."""
    return re.sub(r"//[^/]*@", "//", uri)


def connect(uri: str, experiment: str) -> tuple[MlflowClient, str]:
    """A client of the store and the experiment's id; the experiment, and a SQLite store, are made if need be.

    Raises
    ------
    ConfigError
        Within seconds, if the store cannot be used.
    """
    with reaching(uri):
        artifacts = _probe_database(uri)
        client = _client(uri)
        return client, _experiment_id(client, experiment, artifacts)


def find_run(uri: str, run_id: str) -> tuple[MlflowClient, Run]:
    """A client of the store and a run in it; a store that is not there is not made.

    Raises
    ------
    ConfigError
        Within seconds, if the store cannot be used or has no such run.
    """
    if not exists(uri):
        raise ConfigError("tracking.uri", f"{redact(uri)}: no such store")
    with reaching(uri):
        from mlflow.exceptions import MlflowException

        client = _client(uri)
        try:
            return client, client.get_run(run_id)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            raise ConfigError(run_id, f"no such run in {redact(uri)}") from error


@contextmanager
def reaching(uri: str) -> Iterator[None]:
    """MLflow quiet and impatient; what is raised, as a line that names the store."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    import mlflow  # lazily: it takes a second  # noqa: F401

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in ("mlflow.store.db.utils", "sqlalchemy.pool"):  # they log with a traceback what is raised too
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        with _environment(IMPATIENT):
            yield
    except ConfigError:
        raise
    except Exception as error:
        words = cause(error)
        problem = OTHER_VERSION if "out-of-date database schema" in words else words
        raise ConfigError("tracking.uri", f"{redact(uri)}: {problem}") from error


def _client(uri: str) -> MlflowClient:
    """MLflow's client of a store."""
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=uri)


def _experiment_id(client: MlflowClient, name: str, artifacts: str | None) -> str:
    """Find the experiment or create it, its files at `artifacts`."""
    from mlflow.exceptions import MlflowException

    known = client.get_experiment_by_name(name)
    if known is None:
        try:
            return client.create_experiment(name, artifact_location=artifacts)
        except MlflowException:
            known = client.get_experiment_by_name(name)
            if known is None:  # else another process created it meanwhile
                raise
    if known.lifecycle_stage != "active":
        raise ConfigError("tracking.experiment", f"{name} is deleted in the store; restore it")
    return known.experiment_id


def _probe_database(uri: str) -> str | None:
    """Fail at once where MLflow would try for minutes; return where a SQLite store's files belong."""
    import sqlalchemy
    from mlflow.store.db.db_types import DATABASE_ENGINES

    if re.split(r"[:+]", uri)[0] not in DATABASE_ENGINES:
        return None
    url = sqlalchemy.make_url(uri)
    if url.get_backend_name() != "sqlite":
        sqlalchemy.create_engine(url).connect().close()
        return None
    if url.database in (None, "", ":memory:"):
        raise ValueError("a database in memory keeps nothing")
    path = _resolved(str(url.database))
    artifacts = path.parent / "mlartifacts"
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no folder {path.parent}")
    if artifacts.exists() and not artifacts.is_dir():
        raise NotADirectoryError(f"{artifacts} is in the place of the folder for its files")
    _remove_parts(path)
    if not path.exists() or not path.stat().st_size:
        _create(path)
    with closing(sqlite3.connect(path)) as database:
        _check_tables(database)
        database.execute("BEGIN IMMEDIATE")
        database.execute("CREATE TABLE probe (value)")  # fails where it cannot be written; never committed
    return artifacts.as_uri()


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse a database that is no store, or of which somebody dropped a table."""
    there = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    lacking = sorted(TABLES - there)
    if there and lacking:
        raise ValueError(f"no store of MLflow's, as it lacks the tables {', '.join(lacking)}")


def _create(path: Path) -> None:
    """Make a SQLite store elsewhere and put it in its place when it is whole.

    MLflow can never use a database again in whose making it was killed. If another process is quicker, its
    store stays.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    shutil.copyfile(_empty_store(), part)
    _client(f"sqlite:///{part}").search_experiments(max_results=1)  # makes MLflow's own experiment
    if path.exists() and not path.stat().st_size:
        path.unlink(missing_ok=True)
    try:
        os.link(part, path)  # unlike a rename, it replaces nothing
    except FileExistsError:
        pass
    except OSError:  # a file system without links
        part.replace(path)
    part.unlink(missing_ok=True)


def _remove_parts(path: Path) -> None:
    """Remove what processes left that were killed while they made this store."""
    number = re.compile(rf"\.{re.escape(path.name)}\.(\d+){re.escape(PART)}")
    with suppress(OSError):  # where others may write but not read
        for part in path.parent.iterdir():  # also what SQLite has beside them, as a journal
            if (match := number.match(part.name)) and not _alive(int(match[1])):
                part.unlink(missing_ok=True)


def _empty_store() -> Path:
    """A store without experiments, made once: its tables take MLflow seconds."""
    from mlflow import __version__

    store = cache_folder("stores") / f"mlflow_{__version__}.db"
    if not store.exists():
        new = store.with_name(f".{store.name}.{os.getpid()}{PART}")
        new.unlink(missing_ok=True)
        _client(f"sqlite:///{new}").search_experiments(max_results=1)
        with closing(sqlite3.connect(new)) as database:
            database.execute("DELETE FROM experiments")  # whose files would lie in this process's folder
            database.commit()
        new.replace(store)
    return store


def _alive(pid: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True


def exists(uri: str) -> bool:
    """Whether there is a store; no look at it is taken unless it is a SQLite database."""
    file = database(uri)
    return file is None or file.exists()


def database(uri: str) -> Path | None:
    """The file of a SQLite store; None of other stores.

    Raises
    ------
    ConfigError
        If the address is none.
    """
    if not uri.startswith("sqlite"):
        return None
    try:
        return _resolved(plain[1] if (plain := PLAIN.fullmatch(uri)) else _file(uri))
    except (ValueError, OSError) as error:
        raise ConfigError("tracking.uri", cause(error)) from error


def _file(uri: str) -> str:
    """What SQLAlchemy, which takes a fifth of a second to import, reads as the file in an address.

    Raises
    ------
    ValueError
        If it is no address.
    """
    import sqlalchemy

    try:
        return str(sqlalchemy.make_url(uri).database)
    except sqlalchemy.exc.ArgumentError as error:
        raise ValueError(str(error)) from error


def _resolved(file: str) -> Path:
    """The file that links lead to.

    Raises
    ------
    OSError
        If they lead in a circle.
    """
    path = Path(os.path.realpath(file))
    if path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), file)
    return path


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Environment variables that the user has not set, for a while."""
    added = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def cause(error: BaseException) -> str:
    """What an error comes from, in one line: the system's or SQLite's own words, if it comes from there."""
    chain: list[BaseException] = [error]
    while (deeper := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(deeper)
    own = [link for link in chain if isinstance(link, OSError | sqlite3.Error)]
    words = str(own[-1] if own else error).strip() or type(error).__name__
    return redact(textwrap.shorten(words.splitlines()[0], 200, placeholder=" ..."))
