"""The studies that try policies, run as commands, shortened."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd
from conftest import ROOT


def run(folder: Path, *command: str) -> str:
    """What a Python command prints that runs in a folder."""
    found = subprocess.run(
        [sys.executable, *command], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert found.returncode == 0, found.stderr
    return found.stdout


def study(name: str) -> str:
    """Its file."""
    return str(ROOT / "tests" / "studies" / f"{name}.py")


def test_last_policies_of_a_sweep_are_tried(tmp_path: Path) -> None:
    run(tmp_path, "-m", "simbias", "+sweep=smoke")
    printed = run(tmp_path, study("last_policies"), "smoke", "policies.csv")
    head, _, *body = printed.splitlines()
    assert head.endswith("| succeeded | starts that the last policy balances |")
    assert [line.split(" | ")[0] for line in body] == ["| 0", "| 0.2"]
    found = pd.read_csv(tmp_path / "policies.csv")
    assert list(found["repetition"]) == [0, 0, 1, 1]
    assert found["balanced"].between(0, 20).all()
    assert set(found["starts"]) == {20}


def test_a_policy_is_searched_on_the_hardware(tmp_path: Path) -> None:
    short = ["--seeds", "1", "--evaluations", "3", "task.horizon=60", "optimizer.max_evaluations=20"]
    run(tmp_path, study("searched_on_hardware"), "found.csv", *short)
    (found,) = pd.read_csv(tmp_path / "found.csv").to_dict("records")
    assert (found["seed"], found["starts"]) == (0, 20)
    assert found["hardware_balances"] == found["simulated_balances"] == 20  # nobody falls within 60 ms
