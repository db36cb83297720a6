"""Runs of an MLflow store, to which trials and sweeps are exported; identified by their hash.

A few large writes take a fraction of the time of many small ones.
"""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core.cache import cache_folder
from simbias.core.commands import python
from simbias.core.digest import short_digest
from simbias.core.errors import ConfigError
from simbias.core.messages import redact
from simbias.engine import workplace
from simbias.mlflow import pages, store
from simbias.sweep.tracking import Export
from simbias.trial.disk import locked

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

URI, EXPERIMENT = "sqlite:///mlflow.db", "simbias"  # defaults
EXPORT_LOCK = ".export.lock"  # in a folder, while its run is written
AWAY = "simbias: MLflow: %s. All is kept in %s; once the store works, show it with:  %s"
BACK = "simbias: MLflow: %s works again"
RETRY_SECONDS, RETRY_SHARE = 60.0, 0.1  # least time until a store is tried again; most time spent on it
NOT_EXPORTED = "simbias: MLflow does not show a trial: %s"

OUTDATED = "outcome", "superseded"  # tag of a run whose trial has a later one

Point = tuple[str, float, int, float]  # name, value, step, s since the epoch
Files = Mapping[str, Path | bytes]  # by artifact name: a file to copy, or content to write


class Runs:
    """An experiment of an MLflow store, and the runs in it.

    Raises
    ------
    ConfigError
        If the store cannot be used; an unreachable server is only reported, by `reach`.
    """

    def __init__(self, uri: str, experiment: str, trials: Path) -> None:
        self.uri, self._experiment, self._trials = uri, experiment, trials
        self.away = False  # whether the store was unreachable at the last write
        self._retry = 0.0  # when it is tried again, by time.monotonic()
        self._client: MlflowClient | None = None
        if not store.is_server(self.uri):
            self._connect()

    def _connect(self) -> MlflowClient:
        """Reach the store, or raise a ConfigError."""
        self._client, self._experiment_id = store.connect(self.uri, self._experiment)
        self._file = store.database(self.uri)
        self._number = store.file_number(self._file)
        return self._client

    @property
    def client(self) -> MlflowClient:
        """MLflow's client of the store.

        Raises
        ------
        ConfigError
            If it cannot be used, or has vanished from its place, where MLflow would create a new one.
        """
        if self._client is None:
            return self._connect()
        if store.file_number(self._file) != self._number:
            raise ConfigError(
                "tracking.uri", f"{redact(self.uri, self.uri)}: the store was moved or replaced"
            )
        return self._client

    @property
    def experiment_id(self) -> str:
        """The experiment's id; errors as for `client`."""
        if self._client is None:
            self._connect()
        return self._experiment_id

    def address(self, identity: str, run_id: str) -> str:
        """How to view the run of a hash: a command, or a page on a server."""
        if store.is_server(self.uri):
            uri = redact(self.uri, self.uri)
            return f"{uri.rstrip('/')}/{pages.run_page(self.experiment_id, run_id)}"
        return self._command("ui", identity)

    def _command(self, *words: str, **more: tuple[object, object]) -> str:
        """A command on this store, for pasting; `more` are tracking values, each with its default."""
        uri = redact(self.uri, self.uri)
        values = {"uri": (uri, URI), "experiment": (self._experiment, EXPERIMENT), **more}
        changed = [f"tracking.{key}={value}" for key, (value, usual) in values.items() if value != usual]
        return f"{python()} {shlex.join(['-m', 'simbias', *words, *changed])}"

    @property
    def export_command(self) -> str:
        """The command that exports all trials to the store, for pasting."""
        return self._command("export", trials=(self._trials, store.trials_beside(self.uri)))

    def page(self, identity: str | None) -> str:
        """The page within the UI of the run with this hash, or of all runs; ConfigError if there is none."""
        if identity is None:
            return pages.list_page(self.experiment_id)
        found = self._search(f"tags.hash = '{identity}'") if identity.isalnum() else iter(())
        run = min(found, key=superseded, default=None)  # the newest one, unless it is superseded
        if run is None:
            raise ConfigError(identity, "no run of the store has this hash; `export` shows a folder's trials")
        return pages.run_page(self.experiment_id, run.info.run_id)

    def reach(self, write: Callable[[], None], again: bool = False) -> None:
        """Write to the store; after a failure, which is reported, skip it for a while, or until `again`."""
        begun = time.monotonic()
        if self.away and not again and begun < self._retry:
            return
        log = logging.getLogger(__name__)
        try:
            with store.reaching(self.uri):
                readable(write)
            if self.away:
                log.warning(BACK, redact(self.uri, self.uri))
            self.away = False
        except ConfigError as error:
            if not self.away:
                log.warning(AWAY, error, self._trials, self.export_command)
            self.away, now = True, time.monotonic()
            self._retry = now + max(RETRY_SECONDS, (now - begun) / RETRY_SHARE)

    def find(self, identity: str) -> list[Run]:
        """The runs with this hash, newest first."""
        return [*self._search(f"tags.hash = '{identity}'")]

    def orphaned(self, run: Run) -> bool:
        """Whether a run's sweep has dropped it, or was deleted, perhaps also from the store (`mlflow gc`)."""
        from mlflow.exceptions import MlflowException

        try:
            if not (parent := parent_of(run)):
                return pages.DROPPED in run.data.tags
            return self.client.get_run(parent).info.lifecycle_stage == "deleted"
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return True

    def free(self, run: Run) -> bool:
        """Forget that a sweep has dropped the run; whether one had."""
        dropped = pages.DROPPED in run.data.tags
        if dropped:
            self.client.delete_tag(run.info.run_id, pages.DROPPED)
        return dropped

    def writing(self, folder: Path) -> AbstractContextManager[None]:
        """A lock for writing a folder's run, against all processes that may write to the folder.

        Without permission to do so, against other processes of this installation.
        """
        lock, seconds = folder / EXPORT_LOCK, store.MAKING_SECONDS
        taken = ConfigError("tracking.uri", f"another process has been writing a run for {seconds:g} s")
        if not os.access(lock if lock.exists() else folder, os.W_OK):
            lock = cache_folder("stores") / f"{short_digest(str(folder.resolve()).encode())}.lock"
        return locked(lock, seconds, taken)

    def nested(self, parent: str) -> dict[str, list[Run]]:
        """The runs of a sweep's trials by hash, newest first."""
        found: dict[str, list[Run]] = {}
        for run in self._search(f"tags.`{pages.PARENT}` = '{parent}'"):
            found.setdefault(run.data.tags.get("hash", ""), []).append(run)
        return found

    def create(self, name: str, tags: Mapping[str, str], start_time: int | None = None) -> Run:
        """A new run; its start in ms since the epoch, now if None."""
        return self.client.create_run(
            self.experiment_id, run_name=name, tags=dict(tags), start_time=start_time
        )

    def end(self, run: Run, status: str, end_time: int | None = None) -> None:
        """Set a run's status, and its end in ms since the epoch (now if None), unless already set."""
        if run.info.status == status and end_time in (None, run.info.end_time):
            return
        if status == "RUNNING":
            self.client.update_run(run.info.run_id, status=status)
        else:
            self.client.set_terminated(run.info.run_id, status, end_time=end_time)

    def _search(self, filter_string: str) -> Iterator[Run]:
        """Runs of the experiment, newest first."""
        token: str | None = None
        while True:
            page = self.client.search_runs([self.experiment_id], filter_string, page_token=token)
            yield from page
            token = page.token
            if not token:
                return


def parent_of(run: Run) -> str:
    """The id of the run that a run is nested in; "" if none."""
    return run.data.tags.get(pages.PARENT, "")


def readable(write: Callable[[], None]) -> bool:
    """Write; an unreadable file of a trial is reported, but is not a failure of the store."""
    try:
        write()
    except ConfigError as error:
        if error.key.startswith("tracking."):
            raise
        logging.getLogger(__name__).warning(NOT_EXPORTED, error)
        return False
    return True


class RunExport(Export):
    """Updates a run from a folder, creating it if necessary."""

    def __init__(self, runs: Runs, path: Path) -> None:
        super().__init__()
        self.runs, self.path = runs, path
        self.run_id = ""
        self._uploaded: dict[str, int | None] | None = None  # file sizes of the run's artifacts

    @abstractmethod
    def write(self, final: bool = False) -> None:
        """Write what the run lacks; a ConfigError if a file of the folder cannot be read.

        `final` means that nothing more follows.
        """

    def update(self, final: bool = False) -> None:
        """Update the run; `final` retries an unreachable store."""
        self.runs.reach(lambda: self.write(final), final)

    @property
    def where(self) -> str:
        """How to view the run; if the store is unreachable, its folder and how to export it later."""
        if self.runs.away:
            return f"{self.path}; in MLflow, once the store works:  {self.runs.export_command}"
        identity = self.path.name.rpartition("_")[2]  # a sweep's name comes before its hash
        return self.runs.address(identity, self.run_id) if self.run_id else str(self.path)

    def bring(
        self,
        run: Run,
        files: Files,
        tags: Mapping[str, str],
        parameters: Mapping[str, str],
        metrics: Sequence[Point],
        again: bool = False,
    ) -> None:
        """Write texts and numbers, which appear last and in their order.

        Before, write files that are missing or differ in size; all files if `again`.
        """
        from mlflow.entities import Metric, Param, RunTag

        client, run_id = self.runs.client, run.info.run_id
        known, self._uploaded = self._uploaded, None  # looked up again after a failure
        if known is None:
            folders = {name.rpartition("/")[0] for name in files} if pages.NOTE in run.data.tags else ()
            listed = (client.list_artifacts(run_id, folder or None) for folder in folders)
            known = {file.path: file.file_size for some in listed for file in some}
        sizes = {
            name: len(content) if isinstance(content, bytes) else content.stat().st_size
            for name, content in files.items()
        }
        lacking = [name for name in sizes if again or sizes[name] != known.get(name)]
        if lacking:
            with workplace.temporary_folder() as folder:
                for name in lacking:
                    path, content = Path(folder, name), files[name]
                    path.parent.mkdir(parents=True, exist_ok=True)
                    if isinstance(content, bytes):
                        path.write_bytes(content)
                    else:
                        shutil.copyfile(content, path)
                client.log_artifacts(run_id, folder)
        client.log_batch(  # in parts of the size that MLflow accepts
            run_id,
            metrics=[Metric(name, value, int(1000 * time), step) for name, value, step, time in metrics],
            params=[Param(key, value) for key, value in parameters.items()],
            tags=[RunTag(key, value) for key, value in tags.items()],
        )
        self._uploaded = {**known, **sizes}


def superseded(run: Run) -> bool:
    """Whether a later run shows the trial."""
    tag, value = OUTDATED
    return run.data.tags.get(tag) == value
