from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from simbias.tracking.store import connect


@pytest.fixture(scope="session")
def new_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with nothing in it: creating one takes a second."""
    folder = tmp_path_factory.mktemp("new store")
    connect(f"sqlite:///{folder}/mlflow.db", "another")
    return folder / "mlflow.db"


@pytest.fixture
def folder(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(new_store, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path
