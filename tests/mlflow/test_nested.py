"""A sweep's runs are the same whether they come from the database's tables or through MLflow."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from mlflow import MlflowClient

from simbias.mlflow import nested
from simbias.mlflow.fields import PARENT
from simbias.mlflow.store import connect

RUNS = 7


@pytest.fixture
def sweep(tmp_path: Path) -> tuple[MlflowClient, str, str]:
    """A store with a sweep whose trials ended in different ways, one of them deleted, and a stranger."""
    uri = f"sqlite:///{tmp_path / 'a store.db'}"
    connect(uri, "another")
    client = MlflowClient(uri)
    experiment = client.create_experiment("e", artifact_location=(tmp_path / "files").as_uri())
    parent = client.create_run(experiment).info.run_id
    client.create_run(experiment, tags={"hash": "stranger"})
    for index in range(RUNS):
        tags = {PARENT: parent, "hash": f"h{index}", "other": "x"}
        run = client.create_run(experiment, tags=tags, start_time=1000 - index).info.run_id
        if index % 2:
            client.set_tag(run, "outcome", "succeeded")
            client.log_metric(run, "trial/experiments", 2.0 + index)
            client.log_metric(run, "trial/experiments", 3.0 + index)
            client.set_terminated(run, "FINISHED")
    client.delete_run(run)
    return client, experiment, parent


@pytest.mark.slow
def test_the_tables_are_read_as_mlflow_reads_them(sweep: tuple[MlflowClient, str, str]) -> None:
    client, experiment, parent = sweep
    file = nested.database(client.tracking_uri)
    assert file is not None
    through = list(nested._from_client(client, experiment, parent))
    assert nested._from_database(file, experiment, parent) == through
    assert nested.nested_runs(client, experiment, parent) == through
    assert [run.tags["hash"] for run in through] == [f"h{index}" for index in reversed(range(RUNS - 1))]
    assert [run.metrics for run in through if run.metrics] == [{"trial/experiments": 8.0}] + [
        {"trial/experiments": 3.0 + index} for index in (3, 1)
    ]


@pytest.mark.slow
def test_tables_of_another_mlflow_are_read_by_mlflow(
    sweep: tuple[MlflowClient, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    client, experiment, parent = sweep

    def changed(*_: object) -> None:
        raise sqlite3.OperationalError("no such column: runs.run_uuid")

    through = list(nested._from_client(client, experiment, parent))
    monkeypatch.setattr(nested, "_from_database", changed)
    assert nested.nested_runs(client, experiment, parent) == through


@pytest.mark.slow
def test_a_sweeps_runs_are_found_without_mlflow(sweep: tuple[MlflowClient, str, str]) -> None:
    client, experiment, parent = sweep
    file = nested.database(client.tracking_uri)
    assert file is not None
    assert nested.runs_of_sweep(file, "e", "s") == []
    client.set_tag(parent, "hash", "s")
    assert nested.runs_of_sweep(file, "e", "s") == []  # a trial of that hash
    client.set_tag(parent, "sweep", "mine")
    assert nested.runs_of_sweep(file, "e", "s") == nested.nested_runs(client, experiment, parent) != []
    assert nested.runs_of_sweep(file, "another", "s") == []
    client.delete_experiment(experiment)
    assert nested.runs_of_sweep(file, "e", "s") == []
    assert nested.runs_of_sweep(file.with_name("none.db"), "e", "s") == []
