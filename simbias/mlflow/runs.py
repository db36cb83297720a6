"""Runs of an MLflow store that trials and sweeps were exported to, found again by their hash."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simbias.core.commands import python
from simbias.core.errors import ConfigError
from simbias.mlflow import pages
from simbias.mlflow.store import connect, reaching, redact

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

LOG = "exports.jsonl"  # beside the trials: a line for each run; may be deleted, finding runs is slower then
SPARING = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"  # a fifth of the memory, and sooner up
AWAY = "simbias: MLflow: %s. All is kept in %s; `python -m simbias export` shows it once the store is back"


class Runs:
    """An experiment of an MLflow store, and the runs in it.

    Parameters
    ----------
    uri, experiment
        The store, and its experiment.
    trials
        Folder of the trials.

    Raises
    ------
    ConfigError
        If the store cannot be used; a server that is away is told in one line, and stops nothing.
    """

    def __init__(self, uri: str, experiment: str, trials: Path) -> None:
        self.uri, self._experiment, self._trials = uri, experiment, trials
        self._away = False
        self._known: dict[tuple[str, str], str] = {}  # by hash and parent
        self._client: MlflowClient | None = None
        if not self._is_server:
            self._connect()

    @property
    def _is_server(self) -> bool:
        """Whether the store is a server, which may be away for a while."""
        return self.uri.startswith(("http://", "https://"))

    def _connect(self) -> None:
        """Reach the store; read which runs are known in this experiment."""
        self._client, self.experiment_id = connect(self.uri, self._experiment)
        log = self._trials / LOG
        for line in log.read_text(encoding="utf-8").splitlines() if log.exists() else []:
            try:
                store, experiment_id, identity, parent, run_id = json.loads(line)
            except ValueError:  # cut off by a kill
                continue
            if (store, experiment_id) == (redact(self.uri), self.experiment_id):
                self._known[identity, parent] = run_id

    @property
    def client(self) -> MlflowClient:
        """MLflow's client of the store."""
        if self._client is None:
            self._connect()
        assert self._client is not None
        return self._client

    def address(self, run_id: str) -> str:
        """How a person looks at a run: a command and a page, or the page of a server."""
        page, uri = "/" + pages.run_page(self.experiment_id, run_id), redact(self.uri)
        if self._is_server:
            return uri.rstrip("/") + page
        ui = f"{SPARING} {python()} -m mlflow ui --workers 1"
        return f"{ui} --backend-store-uri {shlex.quote(uri)}  # http://127.0.0.1:5000{page}"

    def reach(self, write: Callable[[], None], again: bool = False) -> None:
        """Write into the store; one that fails is told once, and left alone until `again`."""
        if self._away and not again:
            return
        try:
            with reaching(self.uri):
                write()
            self._away = False
        except ConfigError as error:
            if not self._away:
                logging.getLogger(__name__).warning(AWAY, error.problem, self._trials)
            self._away = True

    def run(self, identity: str, parent: str = "", **new: Any) -> Run:
        """The run of this hash below a parent; created with `new` if there is none."""
        key = (identity, parent)
        if key not in self._known:
            found = self._search(f"tags.hash = '{identity}'")
            self._known |= {(identity, run.data.tags.get(pages.PARENT, "")): run.info.run_id for run in found}
        if key in self._known and (run := self._active(self._known[key])) is not None:
            return run
        return self.create(identity, parent, **new)

    def create(self, identity: str, parent: str = "", tags: Mapping[str, str] = {}, **new: Any) -> Run:
        """A new run."""
        own = {**tags, "hash": identity, **({pages.PARENT: parent} if parent else {})}
        run = self.client.create_run(self.experiment_id, tags=own, **new)
        self._known[identity, parent] = run.info.run_id
        line = [redact(self.uri), self.experiment_id, identity, parent, run.info.run_id]
        self._trials.mkdir(parents=True, exist_ok=True)
        with (self._trials / LOG).open("a", encoding="utf-8") as log:
            log.write(f"{json.dumps(line)}\n")
        return run

    def knows(self, identity: str, parent: str) -> bool:
        """Whether a nested run is known, without a look at the store."""
        return (identity, parent) in self._known

    def find_nested(self, parent: str) -> None:
        """Learn of all runs of a parent at once."""
        if not any(each == parent for _, each in self._known):
            for run in self._search(f"tags.`{pages.PARENT}` = '{parent}'"):
                self._known[run.data.tags.get("hash", ""), parent] = run.info.run_id

    def _active(self, run_id: str) -> Run | None:
        """A run, unless somebody deleted it."""
        from mlflow.exceptions import MlflowException

        try:
            run = self.client.get_run(run_id)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
            return None
        return run if run.info.lifecycle_stage == "active" else None

    def _search(self, filter_string: str) -> Iterator[Run]:
        """Runs of the experiment, oldest first."""
        token: str | None = None
        while True:
            page = self.client.search_runs(
                [self.experiment_id], filter_string, order_by=["created ASC"], page_token=token
            )
            yield from page
            token = page.token
            if not token:
                return
