"""Pages of MLflow's UI: their addresses, and a list of a sweep's trials with the columns to sort by."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

MODE = "workflowType=machine_learning"  # otherwise the UI opens in its mode for language models
VIEW = "mlflow.sharedViewState."  # MLflow's prefix of an experiment's tags that hold views
NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
RUN_NAME = "mlflow.runName"  # MLflow's tag for a run's name
PARENT = "mlflow.parentRunId"  # MLflow's tag that nests runs
AXIS = "axis."  # prefix of the tags with a trial's position on the sweep's axes
DROPPED = "dropped"  # tag of a trial that its sweep has dropped: the sweep's hash
EXPERIMENTS, OUTCOME = "metrics.`trial/experiments`", "tags.`outcome`"


def run_page(experiment_id: str, run_id: str, file: str = "") -> str:
    """Address within the UI of a run, or of a picture among its files."""
    artifact = f"/artifacts/{file}" if file else ""
    return f"#/experiments/{experiment_id}/runs/{run_id}{artifact}?{MODE}"


def list_page(experiment_id: str, parent: str = "") -> str:
    """Address within the UI of all runs, or of a sweep's trials as listed by `trials_view`."""
    view = f"&viewStateShareKey={parent}" if parent else ""
    return f"#/experiments/{experiment_id}/runs?{MODE}{view}"


def trials_view(sweep: Mapping[str, Any], parent: str) -> tuple[str, str]:
    """Experiment tag (key, value) that makes MLflow list a sweep's trials, fewest experiments first.

    A trial without success counts as the method's maximum.
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
    return VIEW + parent, json.dumps({**view, **state})  # views without a name are the state itself


def _column(axis: Mapping[str, Any]) -> str:
    """The column of a trial's position on an axis: its parameter or, if there are several, the label."""
    return f"params.`{axis['keys'][0]}`" if len(axis["keys"]) == 1 else f"tags.`{AXIS}{axis['name']}`"


def _width(column: str) -> int:
    """Pixels needed to show a column's heading, and an outcome."""
    _, head, _ = column.split("`")
    return max(110, 25 + 13 * len(head) // 2)
