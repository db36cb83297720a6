"""What ran where: kept with each trial, and told where trials mix kinds of machines."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from mlflow import MlflowClient
from sweeping import NO_FIGURES, QUICK, runs

from simbias.__main__ import main
from simbias.core import platform as machine

GENERIC = {"NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Prescott"}
SWEEP = ["+sweep=smoke", NO_FIGURES, "sweep.trials=1", "engine=sequential", "tracking.pictures=false", *QUICK]


def uri(folder: Path) -> str:
    return f"tracking.uri=sqlite:///{folder}/mlflow.db"


def test_a_kind_tells_what_makes_the_last_bits() -> None:
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
def test_a_sweep_that_mixes_machines_says_so_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert main([*SWEEP, uri(tmp_path)]) == 0
    assert caplog.messages == []
    here = machine.kind()
    monkeypatch.setattr(machine, "kind", lambda: "another")
    assert main([*SWEEP, "sweep.trials=2", uri(tmp_path)]) == 0
    (line,) = caplog.messages
    assert line == (
        "simbias: trials of this sweep are from 2 kinds of machines, so their last bits may differ: "
        f"2 on {here}; 1 on another"
    )
    (parent,), trials = runs(tmp_path)
    assert sorted(run.data.tags["machine"] for run in trials) == sorted([here, here, "another", "another"])
    assert all(run.data.tags["processor"] for run in trials)
    assert "several kinds of machines" in parent.data.tags["mlflow.note.content"]


@pytest.mark.slow
def test_a_trial_that_goes_on_elsewhere_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Only if anything of it was made before."""
    trial = [*QUICK, "hardware=pymunk", "tracking.pictures=false", "cost.max_cost=1e-3", uri(tmp_path)]

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("simbias.robots.bongoboard.pymunk.PymunkBongoboard.run", interrupt)
        assert main(trial) == 130
    assert caplog.messages == []
    here = machine.kind()
    monkeypatch.setattr(machine, "kind", lambda: "another")
    assert main(trial) == 1
    (line,) = caplog.messages
    assert line.startswith("simbias: trial ")
    assert line.endswith(f" mixes kinds of machines, so its last bits are of neither: {here}; now another")
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path}/mlflow.db")
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (only,) = client.search_runs([experiment.experiment_id])
    assert only.data.tags["machine"] == f"{here} then another"
