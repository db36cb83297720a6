"""Runs of an MLflow store that trials and sweeps were exported to, found again by their hash."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core.commands import python
from simbias.core.errors import ConfigError
from simbias.mlflow import pages
from simbias.mlflow.store import connect, is_server, reaching, redact

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

URI, EXPERIMENT = "sqlite:///mlflow.db", "simbias"  # where none are named
AWAY = "simbias: MLflow: %s. All is kept in %s; `python -m simbias export` shows it once the store is back"
NOT_EXPORTED = "simbias: MLflow does not show a trial: %s"


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
        If the store cannot be used; a server that is away is reported by `reach`, and stops nothing.
    """

    def __init__(self, uri: str, experiment: str, trials: Path) -> None:
        self.uri, self._experiment, self._trials = uri, experiment, trials
        self._away = False
        self._client: MlflowClient | None = None
        if not is_server(self.uri):
            self.connect()

    def connect(self) -> None:
        """Reach the store.

        Raises
        ------
        ConfigError
            If it cannot be used.
        """
        self._client, self.experiment_id = connect(self.uri, self._experiment)

    @property
    def client(self) -> MlflowClient:
        """MLflow's client of the store."""
        if self._client is None:
            self.connect()
        assert self._client is not None
        return self._client

    def address(self, identity: str, run_id: str) -> str:
        """How a person looks at the run of a hash: a command, or the page of a server."""
        uri = redact(self.uri)
        if is_server(self.uri):
            return f"{uri.rstrip('/')}/{pages.run_page(self.experiment_id, run_id)}"
        values = {"uri": (uri, URI), "experiment": (self._experiment, EXPERIMENT)}
        changed = [f"tracking.{key}={value}" for key, (value, usual) in values.items() if value != usual]
        return f"{python()} {shlex.join(['-m', 'simbias', 'ui', identity, *changed])}"

    def page(self, identity: str | None) -> str:
        """The page of the run of this hash, or of all runs, within the UI.

        Raises
        ------
        ConfigError
            If no run has the hash.
        """
        if identity is None:
            return pages.list_page(self.experiment_id)
        found = self._search(f"tags.hash = '{identity}'") if identity.isalnum() else iter(())
        run = next(found, None)
        if run is None:
            raise ConfigError(identity, "no run of the store has this hash; `export` shows a folder's trials")
        return pages.run_page(self.experiment_id, run.info.run_id)

    def reach(self, write: Callable[[], None], again: bool = False) -> None:
        """Write into the store; one that fails is reported once, and left alone until `again`.

        A file of a trial that cannot be read is reported too, and is no failure of the store.
        """
        if self._away and not again:
            return
        try:
            with reaching(self.uri):
                write()
            self._away = False
        except ConfigError as error:
            log = logging.getLogger(__name__)
            if not error.key.startswith("tracking."):
                log.warning(NOT_EXPORTED, error)
                return
            if not self._away:
                log.warning(AWAY, error, self._trials)
            self._away = True

    def find(self, identity: str) -> list[Run]:
        """The runs of this hash that are in no sweep; those that somebody deleted are not found."""
        found = self._search(f"tags.hash = '{identity}'")
        return [run for run in found if pages.PARENT not in run.data.tags]

    def nested(self, parent: str) -> dict[str, Run]:
        """The runs of a sweep's trials by their hash."""
        found = self._search(f"tags.`{pages.PARENT}` = '{parent}'")
        return {run.data.tags.get("hash", ""): run for run in found}

    def create(self, name: str, tags: Mapping[str, str], start_time: int | None = None) -> Run:
        """A new run; its start in ms since the epoch, now if None."""
        return self.client.create_run(
            self.experiment_id, run_name=name, tags=dict(tags), start_time=start_time
        )

    def _search(self, filter_string: str) -> Iterator[Run]:
        """Runs of the experiment, newest first."""
        token: str | None = None
        while True:
            page = self.client.search_runs([self.experiment_id], filter_string, page_token=token)
            yield from page
            token = page.token
            if not token:
                return
