"""Access to an MLflow store: quiet, and failing within seconds where MLflow would retry for minutes."""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
import sqlite3
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import url2pathname

from simbias.core.errors import ConfigError
from simbias.core.extras import silent
from simbias.core.messages import redact
from simbias.engine import workplace
from simbias.trial.disk import locked

if TYPE_CHECKING:
    from mlflow import MlflowClient

QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}
IMPATIENT = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}  # seconds
LOGGERS = ("mlflow", "alembic", "sqlalchemy.pool")  # they log errors, with tracebacks, that are also raised
OTHER_VERSION = "of another version of MLflow; update MLflow, or make a copy and run `mlflow db upgrade URI`"
NO_FOLDER = "MLflow no longer uses folders as stores; use sqlite:///FILE or the address of a server"
KNOWN = {
    "out-of-date database schema": OTHER_VERSION,
    "filesystem tracking backend": NO_FOLDER,
    "determine home directory": "MLflow needs a home directory; set HOME",
}
DATABASE_SERVERS = ("postgresql", "mysql", "mssql")  # named in MLflow's documentation
SQLITE = re.compile(r"sqlite(\+\w+)?:(//)?(/(?P<file>[^?]*))?(\?.*)?")
ARTIFACTS = "mlartifacts"  # folder of a SQLite store's files, beside it
MOVED = (
    "was moved or copied: its files are in {}; delete it, and make it again with `export`, "
    "its tracking.uri and tracking.trials"
)
LOCAL = (
    "simbias: MLflow: files of runs go to %s on this machine, where other machines do not find them; "
    "several machines need tracking.uri=http://..., an MLflow server"
)
MAKING_SECONDS = 120.0  # that a process waits while another creates the same store


def connect(uri: str, experiment: str) -> tuple[MlflowClient, str]:
    """A client and the experiment's id; the experiment and a SQLite store are created if necessary.

    If the store cannot be used, a ConfigError is raised within seconds.
    """
    with reaching(uri):
        artifacts = _probe_database(uri)
        client = client_of(uri)
        identity = _experiment_id(client, experiment, artifacts)
        if _is_database_server(uri):
            _tell_where_files_go(client.get_experiment(identity).artifact_location)
        return client, identity


def file_number(file: Path | None) -> int:
    """The inode number of a SQLite store's file; 0 if there is none."""
    return file.stat().st_ino if file is not None and file.exists() else 0


@contextmanager
def reaching(uri: str) -> Iterator[None]:
    """Make MLflow quiet and impatient; errors become one line that names the store."""
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        import mlflow  # lazily: it takes a second  # noqa: F401

        with _environment(IMPATIENT), ExitStack() as stack:
            for name in LOGGERS:
                stack.enter_context(silent(name))
            yield
    except ConfigError:
        raise
    except Exception as error:
        words = cause(error)
        problem = next((text for part, text in KNOWN.items() if part in words), words)
        raise ConfigError("tracking.uri", redact(f"{uri}: {problem}", uri)) from error


def is_server(uri: str) -> bool:
    """Whether a store is a server, which may be temporarily unreachable."""
    return uri.startswith(("http://", "https://"))


def _is_database_server(uri: str) -> bool:
    """Whether a store is a database on a server, which holds no files."""
    return re.split(r"[:+]", uri)[0] in DATABASE_SERVERS


def _tell_where_files_go(location: str) -> None:
    """Log a line if an experiment's files lie in a folder that this machine does not have yet."""
    place = urlsplit(location)
    if place.scheme in ("", "file") and not Path(url2pathname(place.path)).is_dir():
        logging.getLogger(__name__).warning(LOCAL, location)


def client_of(uri: str) -> MlflowClient:
    """MLflow's client of a store; relative SQLite files are resolved in the current working folder."""
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=address(uri))


def address(uri: str) -> str:
    """The address of a store for MLflow: of a SQLite file, absolute, with `%` and `?` quoted.

    It names the driver, since MLflow makes a folder of the quoted name for `sqlite:///`.
    """
    if (file := database(uri)) is None:
        return uri
    import sqlalchemy

    url = sqlalchemy.make_url(uri)
    named = url.set(drivername=f"sqlite+{url.get_driver_name()}", database=str(file))
    return named.render_as_string(hide_password=False)


def _experiment_id(client: MlflowClient, name: str, artifacts: str | None) -> str:
    """Find or create the experiment, with its files at `artifacts`."""
    from mlflow.exceptions import MlflowException

    known = client.get_experiment_by_name(name)
    if known is None:
        try:
            return client.create_experiment(name, artifact_location=artifacts)
        except MlflowException:
            known = client.get_experiment_by_name(name)
            if known is None:  # otherwise another process created it meanwhile
                raise
    if known.lifecycle_stage != "active":
        raise ConfigError("tracking.experiment", f"{name} is deleted in the store; restore it")
    location = known.artifact_location
    if artifacts and location != artifacts and location.endswith(f"/{ARTIFACTS}"):
        raise ConfigError("tracking.uri", MOVED.format(location))
    return known.experiment_id


def _probe_database(uri: str) -> str | None:
    """Fail at once where MLflow would retry for minutes; return the place for a SQLite store's files."""
    path = database(uri)
    if path is None:
        if _is_database_server(uri):
            import sqlalchemy

            sqlalchemy.create_engine(uri).connect().close()
        return None
    artifacts = path.parent / ARTIFACTS
    if not path.parent.is_dir():
        raise FileNotFoundError(f"no folder {path.parent}")
    if artifacts.exists() and not artifacts.is_dir():
        raise NotADirectoryError(f"{artifacts} must be a folder, for its files")
    if not _is_made(path):
        _make(path)
    with closing(sqlite3.connect(path)) as file:
        tables = {name for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if tables and "alembic_version" not in tables:  # table of Alembic, which manages MLflow's schema
            raise ValueError("the database of another program")
        file.execute("BEGIN IMMEDIATE")
        file.execute("CREATE TABLE probe (value)")  # fails if not writable; never committed
    return artifacts.as_uri()


def _is_made(path: Path) -> bool:
    """Whether the file of a database exists and is not empty."""
    return path.exists() and path.stat().st_size > 0


def _make(path: Path) -> None:
    """Create a SQLite store elsewhere, and move it into place once complete.

    MLflow cannot use a database if it was killed while creating it.
    """
    taken = ConfigError("tracking.uri", f"another process has been making {path} for {MAKING_SECONDS:g} s")
    with locked(path.with_name(f".{path.name}.lock"), MAKING_SECONDS, taken):
        if _is_made(path):  # created by another process meanwhile
            return
        with workplace.temporary_folder() as folder:
            new, part = Path(folder, path.name), path.with_name(f".{path.name}.part")
            client_of(f"sqlite:///{new}").search_experiments(max_results=1)
            shutil.copyfile(new, part)
        part.replace(path)


def database(uri: str) -> Path | None:
    """The file of a SQLite store, links resolved; None for other stores; ConfigError without a file name."""
    if not uri.startswith("sqlite"):
        return None
    match = SQLITE.fullmatch(uri)
    if match is None:
        raise ConfigError("tracking.uri", f"{uri}: expected an address such as sqlite:///mlflow.db")
    if match["file"] in (None, "", ":memory:"):
        raise ConfigError("tracking.uri", f"{uri}: a database in memory keeps nothing")
    path = Path(os.path.realpath(match["file"]))
    if path.is_symlink():  # circular links
        raise ConfigError("tracking.uri", f"{uri}: {os.strerror(errno.ELOOP)}")
    return path


def trials_beside(uri: str) -> Path:
    """The default folder of trials: beside a SQLite store, else in the working folder."""
    file = database(uri)
    return (file.parent if file else Path()) / "trials"


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables temporarily, unless the user has set them."""
    added = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def cause(error: BaseException) -> str:
    """The cause of an error in one line: the system's or SQLite's own message, if it caused it."""
    chain: list[BaseException] = [error]
    while (deeper := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(deeper)
    own = [link for link in chain if isinstance(link, OSError | sqlite3.Error)]
    words = str(own[-1] if own else error).strip() or type(error).__name__
    return redact(textwrap.shorten(words.splitlines()[0], 200, placeholder=" ..."))
