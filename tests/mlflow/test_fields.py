from __future__ import annotations

import subprocess
from pathlib import Path

import pandas as pd
import pytest

from simbias.mlflow import fields


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_commit_of_the_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fields, "PACKAGE", tmp_path / "simbias")
    commit = fields._commit.__wrapped__
    assert commit() == {}
    git(tmp_path, "init")
    assert commit() == {}
    (tmp_path / "code.py").write_text("a = 1")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "a")
    head = git(tmp_path, "rev-parse", "HEAD")
    expected = {"git.changed": "false", "mlflow.source.git.commit": head}
    assert commit() == expected
    (tmp_path / "code.py").write_text("a = 2")
    assert commit() == {**expected, "git.changed": "true"}


def test_versions_of_all_that_is_required() -> None:
    versions = fields._versions()
    assert {"python", "simbias", "mlflow", "nlopt"} <= set(versions)
    assert "pytest" not in versions


def test_a_sweep_in_numbers() -> None:
    outcomes = ["succeeded", "succeeded", "not succeeded", "error"]
    trials = pd.DataFrame({"outcome": outcomes, "experiments": [4.0, 8.0, 20.0, float("nan")]})
    assert fields.sweep_metrics(trials) == {
        "trials/succeeded": 2.0,
        "trials/not_succeeded": 1.0,
        "trials/error": 1.0,
        "experiments/mean": pytest.approx(32 / 3),
    }
    assert "experiments/mean" not in fields.sweep_metrics(trials[3:])


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("http://me:secret@host:5000/path", "http://host:5000/path"),
        ("postgresql://me:secret@host/x", "postgresql://host/x"),
        ("sqlite:////a/b@c/mlflow.db", "sqlite:////a/b@c/mlflow.db"),
        ("sqlite:///mlflow.db", "sqlite:///mlflow.db"),
    ],
)
def test_shown_uri_has_no_password(uri: str, expected: str) -> None:
    assert fields.redact(uri) == expected
