"""Sweeps as a person starts them, and what their folders hold afterwards."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil
from conftest import PYTHONPATH
from forked import Forked
from texts import write

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

NO_FIGURES = "+sweep.figures={}"  # to draw them takes a second
FOLDERS = ["tracking=folders", "tracking.pictures=false"]
QUICK = ["task.horizon=200", "optimizer.max_evaluations=20", "method.max_iterations=2"]
FOUR_CELLS = """
task: {horizon: 400}
optimizer: {max_evaluations: 20}
method: {max_iterations: 2}
tracking: {pictures: false}
sweep:
  trials: 4
  figures: {}
  axes:
    hardware.noise.torque_variance: [0.0, 0.1]
    hardware.inertia_error: [0.0, 0.2]
"""


def write_sweep(folder: Path, name: str, text: str) -> Path:
    """A config dir with a sweep."""
    return write(folder / "conf", {f"sweeps/{name}.yaml": text})


SIMBIAS = ("-m", "simbias")


def start(
    *arguments: str,
    folder: Path,
    program: Sequence[str] = SIMBIAS,
    temporary: Path | None = None,
    largest_file: int | None = None,  # bytes; of a fork
) -> subprocess.Popen[str] | Forked:
    """A process of its own session, so that signals to it reach no one else."""
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "COLUMNS": "120"}
    if temporary is not None:
        environment["TMPDIR"] = str(temporary)
    if "PYTEST_CURRENT_TEST" in os.environ and program is SIMBIAS:  # but studies
        return Forked(arguments, folder, environment, largest_file)
    return subprocess.Popen(
        [sys.executable, "-u", *program, *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def run(*arguments: str, folder: Path, timeout: float = 120, **options: Any) -> tuple[int, str, str]:
    """Exit status, stdout and stderr; whatever hangs is killed with its workers."""
    process = start(*arguments, folder=folder, **options)
    return finish(process, timeout)


def finish(process: subprocess.Popen[str] | Forked, timeout: float = 120) -> tuple[int, str, str]:
    """Wait for a process, but not for ever."""
    killer = threading.Timer(timeout, lambda: os.killpg(process.pid, signal.SIGKILL))
    killer.start()
    try:
        out, err = process.communicate()
    finally:
        killer.cancel()
    return process.returncode, out, err


def until_trials(process: subprocess.Popen[str] | Forked, count: int) -> None:
    """Read the process' lines until it has told of so many more trials."""
    for line in process.stdout:
        count -= bool(re.match(r"\[\d+/", line))
        if not count:
            return
    raise AssertionError(f"ended early: {process.communicate()}")


def workers(process: subprocess.Popen[str] | Forked) -> list[int]:
    """Processes of loky's that are children of the process."""
    children = psutil.Process(process.pid).children()
    return [child.pid for child in children if any("popen_loky" in word for word in child.cmdline())]


def client_of(folder: Path) -> MlflowClient:
    """Of the store in a folder."""
    from mlflow import MlflowClient  # lazily: it takes seconds

    return MlflowClient(tracking_uri=f"sqlite:///{folder}/mlflow.db")


def runs(folder: Path) -> tuple[list[Run], list[Run]]:
    """Parent runs and trials' runs of the store in a folder."""
    client = client_of(folder)
    experiment = client.get_experiment_by_name("simbias")
    found = list(client.search_runs([experiment.experiment_id], max_results=1000))
    parents = [run for run in found if "sweep" in run.data.tags]
    return parents, [run for run in found if "mlflow.parentRunId" in run.data.tags]


def trial_by_trial(folder: Path) -> dict[str, Any]:
    """Content of all trials by their hashes; asserts that each has ended."""
    trials = {file.parent.name: file.parent for file in folder.glob("trials/*/trial.json")}
    assert all((trial / "outcome.json").exists() for trial in trials.values())
    return {identity: content(trial) for identity, trial in sorted(trials.items())}


def content(trial: Path) -> dict[str, Any]:
    """Files of a trial, comparable: without pictures, attempts, times and versions."""
    files = [*trial.glob("[0-9]*"), *trial.glob("*.json"), *trial.glob("*.csv")]
    return {file.name: _timeless(_read(file)) for file in sorted(files)}


def _read(file: Path) -> Any:
    if file.suffix == ".json":
        return json.loads(file.read_text())
    if file.suffix != ".npz":
        return file.read_text()
    with np.load(file) as arrays:
        return {name: (arrays[name].shape, arrays[name].tobytes()) for name in arrays.files}


def _timeless(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {
        key: _timeless(each)
        for key, each in value.items()
        if key not in ("started", "ended", "seconds", "versions", "commit", "changed")
        and not key.startswith("seconds/")
    }


def sweep_folder(folder: Path) -> Path:
    """The folder of the only sweep."""
    (only,) = folder.glob("trials/sweeps/*")
    return only


def state(folder: Path) -> dict[str, Any]:
    """How far the only sweep is."""
    return json.loads((sweep_folder(folder) / "state.json").read_text())


def table(folder: Path) -> str:
    """The table of the only sweep."""
    return (sweep_folder(folder) / "table.csv").read_text()
