"""What ran where: kept with each trial, and told where trials mix kinds of machines."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from sweeping import FOLDERS, NO_FIGURES, QUICK

from simbias.__main__ import main
from simbias.core import platform as machine
from simbias.trial.folder import TrialFolder

GENERIC = {"NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Prescott"}


@pytest.mark.slow
def test_a_platform_tells_what_makes_the_last_bits() -> None:
    """Also what the environment made of the processor; not its model, which makes none."""
    code = "from simbias.core.platform import kind; print(kind())"
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | GENERIC
    other = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    here = machine.kind()
    assert "\n" not in here
    assert ": generic, NumPy " in other
    assert here != other
    assert machine.processor()


@pytest.mark.slow
def test_a_sweep_that_mixes_platforms_says_so_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sweep = ["+sweep=smoke", NO_FIGURES, "engine=sequential", *QUICK, *FOLDERS, f"tracking.trials={tmp_path}"]
    assert main([*sweep, "sweep.trials=1"]) == 0
    assert caplog.messages == []
    here = machine.kind()
    monkeypatch.setattr(machine, "kind", lambda: "another")
    assert main([*sweep, "sweep.trials=2"]) == 0
    (line,) = caplog.messages
    assert line == (
        "simbias: trials of this sweep are from 2 platforms, so their last bits may differ: "
        f"2 on {here}; 1 on another"
    )
    kept = [tuple(TrialFolder(file.parent).platforms()) for file in tmp_path.glob("*/trial.json")]
    assert sorted(kept) == sorted([(here,), (here,), ("another",), ("another",)])


def test_the_package_is_known_by_its_own_code_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by the loops that were compiled on a machine, which lie beside it."""
    (tmp_path / "code.py").write_text("one = 1")
    monkeypatch.setattr(machine, "PACKAGE", tmp_path)
    digest = machine.package_digest.__wrapped__
    before = digest()
    (tmp_path / "__pycache__" / "closed_loops").mkdir(parents=True)
    (tmp_path / "__pycache__" / "closed_loops" / "loop.py").write_text("")
    assert digest() == before
    (tmp_path / "code.py").write_text("one = 2")
    assert digest() != before
