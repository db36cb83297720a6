"""A trial's folder, found by the id of its run in an MLflow store."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.mlflow.store import find_run, reaching
from simbias.mlflow.trial import FOLDER


@contextmanager
def trial_folder(run_id: str, uri: str) -> Iterator[Path]:
    """The trial's folder, downloaded from its run; it goes with the context.

    Raises
    ------
    ConfigError
        If the store cannot be used, has no such run, or the run is no trial's.
    """
    client, run = find_run(uri, run_id)
    if "sweep" in run.data.tags:
        raise ConfigError(run_id, "is a sweep; each of its trials is a run of its own")
    if "hash" not in run.data.tags:
        raise ConfigError(run_id, "is no run of simbias")
    with tempfile.TemporaryDirectory() as folder:
        with reaching(uri):
            client.download_artifacts(run_id, FOLDER, folder)
        yield Path(folder, FOLDER)
