"""A trial that is killed again and again ends as one that is not; nothing of it is made or told twice."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from logged_hardware import LOG
from mlflow import MlflowClient
from mlflow.entities import Run
from records import assert_equal, timeless
from sweeping import finish, run, start

import simbias
from simbias.mlflow.store import connect
from simbias.mlflow.trials import load_trial
from simbias.trial.run import Outcome, TrialRecord, run_trial

pytestmark = pytest.mark.slow

KILLS = 4
SHORT = [
    *("task.horizon=400", "optimizer.max_evaluations=30", "method.max_iterations=8"),
    "cost.max_cost=1e-3",  # never reached
    *("hardware=logged", "tracking.pictures=false"),
]


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conf")
    (folder / "hardware").mkdir()
    (folder / "hardware" / "logged.yaml").write_text("_target_: logged_hardware.Logged\n")
    (folder / "components.yaml").write_text("allow: [logged_hardware]\n")
    return folder


def begun(folder: Path) -> list[list[float]]:
    """The starts of the experiments that were begun."""
    log = folder / LOG
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def kept(folder: Path) -> int:
    """How many experiments the journal has."""
    return len(list((folder / "journals").glob("*/*/*_experiment.npz")))


@pytest.fixture(scope="module")
def undisturbed(
    conf: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[TrialRecord, list[list[float]]]:
    """The record of the trial, and the starts of its experiments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("undisturbed"))
        record = run_trial(simbias.load(SHORT, conf))
        return record, begun(Path())


def killed(arguments: list[str], folder: Path, seconds: float, in_experiment: bool) -> None:
    """Start the trial, and kill it so long after it has begun, or after its first new experiment has."""
    earlier, deadline = len(begun(folder)), time.monotonic() + 60.0
    process = start(*arguments, folder=folder)
    assert process.stdout is not None
    for line in process.stdout:
        if ", trial " in line:
            break
    while in_experiment and len(begun(folder)) == earlier and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(seconds)
    os.killpg(process.pid, signal.SIGKILL)
    status, _, err = finish(process)
    assert status == -signal.SIGKILL, err


def only_run(folder: Path) -> tuple[MlflowClient, Run]:
    client = MlflowClient(tracking_uri=f"sqlite:///{folder}/mlflow.db")
    experiment = client.get_experiment_by_name("simbias")
    assert experiment is not None
    (only,) = client.search_runs([experiment.experiment_id])
    return client, only


def test_killed_again_and_again_a_trial_ends_as_undisturbed(
    conf: Path, undisturbed: tuple[TrialRecord, list[list[float]]], tmp_path: Path
) -> None:
    expected, starts = undisturbed
    assert (expected.outcome, len(starts)) == (Outcome.NOT_SUCCEEDED, 16)
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    connect(uri, "simbias")
    arguments = ["--config-dir", str(conf), *SHORT]
    rng = random.Random(2015)
    for number in range(KILLS + 1):
        safe, earlier = kept(tmp_path), begun(tmp_path)
        if number < KILLS:
            killed(arguments, tmp_path, rng.uniform(0.0, 0.3), in_experiment=number % 2 == 0)
            made = begun(tmp_path)[len(earlier) :]
            assert made or number % 2
            assert kept(tmp_path) >= safe + max(0, len(made) - 1)  # all but the one under way
        else:
            status, out, err = run(*arguments, folder=tmp_path)
            assert (status, err) == (1, ""), out
            made = begun(tmp_path)[len(earlier) :]
            assert made
        assert made == starts[safe : safe + len(made)]  # none that was kept is made again
    assert made[-1] == starts[-1]
    assert not (tmp_path / "journals").exists()
    check_store(tmp_path, uri, expected)
    earlier = begun(tmp_path)
    status, out, _ = run(*arguments, folder=tmp_path)
    assert (status, begun(tmp_path)) == (1, earlier)
    assert "in an earlier run of this command" in out


def check_store(folder: Path, uri: str, expected: TrialRecord) -> None:
    """One run, with the records of the undisturbed trial, and every metric once an iteration."""
    client, only = only_run(folder)
    assert (only.info.status, only.data.tags["outcome"]) == ("FINISHED", "not succeeded")
    assert "error" not in only.data.tags
    trial = load_trial(only.info.run_id, uri, allow=["logged_hardware"])
    assert_equal(timeless(replace(expected, iterations=trial.iterations)), timeless(expected))
    for name in only.data.metrics:
        steps = [metric.step for metric in client.get_metric_history(only.info.run_id, name)]
        assert steps == ([0] if name.startswith("trial/") else list(range(8))), name
    assert only.data.metrics["trial/experiments"] == 16.0
    assert "**Did not succeed**" in only.data.tags["mlflow.note.content"]
