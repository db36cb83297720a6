from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def folder(new_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(new_store, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path
