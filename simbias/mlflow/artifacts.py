"""Files of a run in an MLflow store: written so that a kill leaves nothing that stays, and removed."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import url2pathname

from simbias.engine.workplace import temporary_folder

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

UPLOADING = ".artifact.uploading.*"  # MLflow's copies that are not yet in their place


def log_text(client: MlflowClient, run_id: str, text: str, name: str) -> None:
    """Write a text, as MLflow's client does, by a file that goes with this process."""
    path = Path(name)
    with temporary_folder() as folder:
        file = Path(folder, path.name)
        file.write_text(text, encoding="utf-8")
        client.log_artifact(run_id, str(file), None if path.parent == Path() else path.parent.as_posix())


def remove_file(run: Run, name: str) -> None:
    """Remove a file, if the store can."""
    from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

    with suppress(Exception):  # not every store removes files; one more does no harm
        get_artifact_repository(str(run.info.artifact_uri)).delete_artifacts(name)


def remove_uploads(run: Run, seconds: float = 0.0) -> None:
    """Remove what MLflow was copying when its process was killed, last touched so many seconds ago.

    Without seconds, nobody else may write into the run.
    """
    folder = _folder(run)
    for file in folder.rglob(UPLOADING) if folder else ():
        with suppress(OSError):  # gone meanwhile
            if time.time() - file.stat().st_ctime >= seconds:
                file.unlink()


def _folder(run: Run) -> Path | None:
    """Where a run's files are, if that is on this machine."""
    address = urlsplit(str(run.info.artifact_uri))
    if address.scheme not in ("", "file") or address.netloc:
        return None
    return Path(url2pathname(address.path))
