"""A sweep is exported to MLflow while it runs; started again, it adds nothing there."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from sweeping import QUICK, client_of, runs, write_sweep

from simbias.__main__ import main

pytestmark = pytest.mark.slow


@pytest.fixture
def store(folder: Path, new_store: Path) -> str:
    """The override that names a store in the working folder."""
    shutil.copy(new_store, folder)
    return f"tracking.uri=sqlite:///{folder}/mlflow.db"


def histories(folder: Path) -> dict[tuple[str, str], list[Any]]:
    """Values of all metrics of all runs."""
    client = client_of(folder)
    found = [run for some in runs(folder) for run in some]
    return {
        (run.info.run_id, name): [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for run in found
        for name in run.data.metrics
    }


def test_a_finished_sweep_started_again_adds_nothing(folder: Path, store: str) -> None:
    command = ["+sweep=smoke", *QUICK, "engine=sequential", "tracking.pictures=false", store]
    assert main(command) == 0
    (parent,), trials = runs(folder)
    assert parent.info.status == "FINISHED"
    assert len(trials) == 4
    assert parent.data.metrics["trials/succeeded"] == 4
    before = histories(folder)
    assert all(len(values) == len({step for step, _ in values}) for values in before.values())
    assert main(command) == 0
    assert histories(folder) == before
    assert runs(folder)[0][0].info.end_time == parent.info.end_time


def test_a_trial_that_waits_has_one_run(folder: Path, store: str) -> None:
    write_sweep(folder, "mine", "sweep: {trials: 1, axes: {bias: [none, gp]}}")
    command = ["--config-dir", "conf", "+sweep=mine", *QUICK, "hardware=manual", "engine=sequential", store]
    for _ in range(2):
        assert main(command) == 3
        assert [run.info.status for run in runs(folder)[1]] == ["SCHEDULED"] * 2
