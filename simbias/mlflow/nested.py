"""The runs of a sweep's trials, as far as a sweep needs them.

MLflow reads a run with all its parameters, metrics and tags, which takes milliseconds each. What is needed of
ten thousand runs comes from a SQLite store with a few queries, in a fraction of a second.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.mlflow.fields import PARENT
from simbias.mlflow.rows import METRICS, TAGS, RunRow, row_of
from simbias.mlflow.store import database

if TYPE_CHECKING:
    from mlflow import MlflowClient

_RUNS = """
SELECT runs.run_uuid, runs.status, runs.end_time FROM runs JOIN tags ON tags.run_uuid = runs.run_uuid
WHERE tags.key = ? AND tags.value = ? AND runs.experiment_id = ? AND runs.lifecycle_stage = 'active'
ORDER BY runs.start_time, runs.run_uuid
"""
_SWEEP = """
SELECT runs.experiment_id, runs.run_uuid FROM runs
JOIN experiments ON experiments.experiment_id = runs.experiment_id
JOIN tags AS hashes ON hashes.run_uuid = runs.run_uuid
JOIN tags AS names ON names.run_uuid = runs.run_uuid
WHERE experiments.name = ? AND experiments.lifecycle_stage = 'active' AND runs.lifecycle_stage = 'active'
AND hashes.key = 'hash' AND hashes.value = ? AND names.key = 'sweep'
ORDER BY runs.start_time, runs.run_uuid
"""
_VALUES = """
SELECT {table}.run_uuid, {table}.key, {table}.value FROM {table}
JOIN tags AS parents ON parents.run_uuid = {table}.run_uuid
WHERE parents.key = ? AND parents.value = ? AND {table}.key IN ({keys})
"""


def nested_runs(client: MlflowClient, experiment_id: str, parent: str) -> list[RunRow]:
    """The runs of a sweep's trials, in any state, oldest first."""
    file = database(client.tracking_uri)
    if file is not None:
        try:
            return _from_database(file, experiment_id, parent)
        except sqlite3.Error:  # its tables are another MLflow's
            pass
    return list(_from_client(client, experiment_id, parent))


def runs_of_sweep(file: Path, experiment: str, sweep: str) -> list[RunRow]:
    """The runs of the trials of the sweep of this hash, without MLflow, which takes seconds to import.

    There are none if there is no such sweep, or if the database is no store.
    """
    with (
        suppress(sqlite3.Error),
        closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True)) as connection,
    ):
        found = connection.execute(_SWEEP, (experiment, sweep)).fetchone()
        return _from_database(file, *found) if found else []
    return []


def _from_database(file: Path, experiment_id: str, parent: str) -> list[RunRow]:
    """As MLflow's tables have them."""

    def values(table: str, keys: tuple[str, ...]) -> dict[str, dict]:
        query = _VALUES.format(table=table, keys=", ".join("?" * len(keys)))
        found: dict[str, dict] = defaultdict(dict)
        for run_id, key, value in connection.execute(query, (PARENT, parent, *keys)):
            found[run_id][key] = value
        return found

    with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True)) as connection:
        runs = connection.execute(_RUNS, (PARENT, parent, int(experiment_id))).fetchall()
        tags, metrics = values("tags", TAGS), values("latest_metrics", METRICS)
        return [
            RunRow(run_id, status, end_time, tags[run_id], metrics[run_id])
            for run_id, status, end_time in runs
        ]


def _from_client(client: MlflowClient, experiment_id: str, parent: str) -> Iterator[RunRow]:
    """As MLflow reads them, from any store."""
    token: str | None = None
    while True:
        page = client.search_runs(
            [experiment_id], f"tags.`{PARENT}` = '{parent}'", order_by=["created ASC"], page_token=token
        )
        yield from map(row_of, page)
        token = page.token
        if not token:
            return
