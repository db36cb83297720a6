"""Pages of MLflow's UI: their addresses, and a list of a sweep's trials with the columns to sort by."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

MODE = "workflowType=machine_learning"  # else the UI opens in its mode for language models
VIEW = "mlflow.sharedViewState."  # MLflow's prefix of an experiment's tags that hold views
NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
RUN_NAME = "mlflow.runName"  # MLflow's tag for its name
PARENT = "mlflow.parentRunId"  # MLflow's tag that nests runs
AXIS = "axis."  # prefix of the tags that say where on the sweep's axes a trial lies
EXPERIMENTS, OUTCOME = "metrics.`trial/experiments`", "tags.`outcome`"


def run_page(experiment_id: str, run_id: str, file: str = "") -> str:
    """Address of a run, or of a picture among its files, within the UI."""
    artifact = f"/artifacts/{file}" if file else ""
    return f"#/experiments/{experiment_id}/runs/{run_id}{artifact}?{MODE}"


def list_page(experiment_id: str, sweep: str = "") -> str:
    """Address, within the UI, of all runs, or of the trials of a sweep's hash as `trials_view` lists them."""
    view = f"&viewStateShareKey={sweep}" if sweep else ""
    return f"#/experiments/{experiment_id}/runs?{MODE}{view}"


def trials_view(sweep: Mapping[str, Any], parent: str) -> tuple[str, str]:
    """Tag of the experiment (key, value) for MLflow to list a sweep's trials: fewest experiments first.

    Without success a trial counts as all that its method may make.
    """
    columns = [EXPERIMENTS, OUTCOME, *map(_column, sweep["axes"])]
    state: dict[str, Any] = {
        "searchFilter": f"tags.`{PARENT}` = '{parent}'",
        "orderByKey": EXPERIMENTS,
        "orderByAsc": True,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "modelVersionFilter": "All Runs",
        "datasetsFilter": [],
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {column: _width(column) for column in columns},
    }
    view = {
        "name": f"sweep {sweep['name']}",
        "createdAt": int(1000 * time.time()),
        "state": json.dumps(state),
    }
    return VIEW + sweep["hash"], json.dumps({**view, **state})  # views without a name are the state itself


def _column(axis: Mapping[str, Any]) -> str:
    """The column that tells where on an axis a trial lies: its parameter, or of several the label."""
    return f"params.`{axis['keys'][0]}`" if len(axis["keys"]) == 1 else f"tags.`{AXIS}{axis['name']}`"


def _width(column: str) -> int:
    """Pixels that show all of a column's head, and an outcome."""
    _, head, _ = column.split("`")
    return max(110, 25 + 13 * len(head) // 2)
