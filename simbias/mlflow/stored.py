"""A trial's folder, found by the id of its run in an MLflow store."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.core.messages import redact
from simbias.mlflow.store import client_of, database, reaching
from simbias.mlflow.trial import FOLDER


@contextmanager
def trial_folder(run_id: str, uri: str) -> Iterator[Path]:
    """The trial's folder, downloaded from its run, and deleted at the end of the context.

    ConfigError if the store cannot be used (a missing one is not created), or has no such trial.
    """
    file = database(uri)
    if file is not None and not file.exists():
        raise ConfigError(run_id, f"no such folder, and no store {redact(uri, uri)} to look for a run in")
    with tempfile.TemporaryDirectory() as folder:
        with reaching(uri):
            _download(run_id, uri, folder)
        yield Path(folder, FOLDER)


def _download(run_id: str, uri: str, folder: str) -> None:
    """Copy the trial's folder from its run."""
    from mlflow.exceptions import MlflowException

    client = client_of(uri)
    try:
        tags = client.get_run(run_id).data.tags
    except MlflowException as error:
        if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            raise
        raise ConfigError(run_id, f"no such run in {redact(uri, uri)}, and no such folder") from error
    if "sweep" in tags:
        raise ConfigError(run_id, "is a sweep; name the run of one of its trials")
    if "hash" not in tags:
        raise ConfigError(run_id, "is not a run of simbias")
    if not any(client.list_artifacts(run_id, FOLDER)):
        raise ConfigError(run_id, "its files are not in the store")
    client.download_artifacts(run_id, FOLDER, folder)
