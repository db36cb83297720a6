"""A sweep is exported to MLflow while it runs; started again, it adds nothing there."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sweeping import NO_FIGURES, QUICK, client_of, runs, write_sweep

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError
from simbias.config.build import service
from simbias.sweep.folder import SweepFolder
from simbias.sweep.running import SweepObserver
from simbias.sweep.state import SweepState
from simbias.sweep.tracking import Export, Folders, Tracking

pytestmark = pytest.mark.slow

SMOKE = ["+sweep=smoke", *QUICK, "engine=sequential", "tracking.pictures=false"]


@pytest.fixture
def folder(folder: Path, new_store: Path) -> Path:
    """The working folder, with a store in it."""
    shutil.copy(new_store, folder)
    return folder


def histories(folder: Path) -> dict[tuple[str, str], list[Any]]:
    """Values of all metrics of all runs."""
    client = client_of(folder)
    found = [run for some in runs(folder) for run in some]
    return {
        (run.info.run_id, name): [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, name)]
        for run in found
        for name in run.data.metrics
    }


def test_a_finished_sweep_started_again_adds_nothing(folder: Path) -> None:
    command = [*SMOKE, f"tracking.uri=sqlite:///{folder}/mlflow.db"]
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


def test_a_trial_that_waits_has_one_run(folder: Path) -> None:
    write_sweep(folder, "mine", "sweep:\n  trials: 1\n  axes:\n    bias: [none, gp]\n")
    command = ["--config-dir", "conf", "+sweep=mine", *QUICK, "hardware=manual", "engine=sequential"]
    for _ in range(2):
        assert main([*command, f"tracking.uri=sqlite:///{folder}/mlflow.db"]) == 3
        assert [run.info.status for run in runs(folder)[1]] == ["SCHEDULED"] * 2


def test_a_finished_sweep_says_so_before_its_store_is_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To import MLflow takes seconds."""
    monkeypatch.chdir(tmp_path)
    events: list[str] = []

    class Slow(Folders):
        def export_sweep(self, folder: SweepFolder, **_: Any) -> Export:
            events.append("export")
            raise ConfigError("tracking.uri", "away")

    class Listener(SweepObserver):
        def begun(self, *_: Any) -> None:
            events.append("begun")

        def all_ended(self) -> None:
            events.append("all ended")

    def slow(own: Any, key: str, kind: type) -> Any:
        return Slow() if kind is Tracking else service(own, key, kind)

    monkeypatch.setattr("simbias.sweep.running.service", slow)
    with pytest.raises(ConfigError, match=r"^tracking\.uri: away$"):
        simbias.run_sweep([*SMOKE, NO_FIGURES], observer=Listener())
    assert events[:2] == ["begun", "export"]
    assert "all ended" in events


def test_overhead_of_a_trial(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What exporting a trial with as much data as the paper's longest costs, in processor time of its thread.

    Not as the difference of whole sweeps: other tests' threads and a busy machine would count too.
    """
    keep, seconds = SweepState.keep, []

    def timed(*arguments: Any) -> None:
        began = time.thread_time()
        keep(*arguments)
        seconds.append(time.thread_time() - began)

    monkeypatch.setattr(SweepState, "keep", timed)
    long = ["method.max_iterations=10", "optimizer.max_evaluations=3", "hardware.feet=separate"]
    quick = ["+sweep=smoke", "engine=sequential", "task.horizon=5000", *long, "tracking.pictures=false"]
    assert main([*quick, "sweep.trials=1", f"tracking.uri=sqlite:///{folder}/mlflow.db"]) == 0
    trials = runs(folder)[1]
    assert len(trials) == len(seconds) == 2
    assert all(trial.data.metrics["experiments/total"] == 20 for trial in trials)
    print(f"overhead of a trial: {np.median(seconds):.3f} s")
    assert np.median(seconds) < 0.3
