from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from simbias.trial import origin


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_commit_of_the_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(origin, "PACKAGE", tmp_path / "simbias")
    commit = origin._commit.__wrapped__
    assert commit() == {}
    git(tmp_path, "init")
    assert commit() == {}
    (tmp_path / "code.py").write_text("a = 1")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "a")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert commit() == {"commit": head, "changed": False}
    (tmp_path / "code.py").write_text("a = 2")
    assert commit() == {"commit": head, "changed": True}


def test_versions_of_all_that_is_required() -> None:
    versions = origin._versions()
    assert {"python", "simbias", "mlflow", "nlopt"} <= set(versions)
    assert "pytest" not in versions
