"""What a sweep's trials found, read back from the store as a DataFrame.

A DataFrame of trials has a row for each, with a column for each of the sweep's axes and `hash`,
`repetition`, `seed`, `outcome` (`succeeded`, `not succeeded` or `error`), `experiments` (hardware experiments
until success; without it all that the method may make, 2 x N_out = 20 by Table I), `iterations` (likewise),
`seconds` (it computed), `raised` (what it raised) and `run_id`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from simbias.config.composition import ConfigError, shipped
from simbias.tracking.fields import AXIS, PARENT

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from simbias.study import Study
    from simbias.sweep.grid import Sweep, Trial
    from simbias.worker import TrialRecord

DIGITS = 4  # of times in published results
COUNTS = ("experiments", "iterations")
COLUMNS = ("hash", "repetition", "seed", "outcome", *COUNTS, "seconds", "raised", "run_id")


def children(client: MlflowClient, experiment_id: str, parent: str) -> Iterator[Run]:
    """The runs of a sweep's trials, in any state, oldest first."""
    token: str | None = None
    while True:
        page = client.search_runs(
            [experiment_id], f"tags.`{PARENT}` = '{parent}'", order_by=["created ASC"], page_token=token
        )
        yield from page
        token = page.token
        if not token:
            return


def find_sweep(client: MlflowClient, experiment_id: str, sweep: Sweep) -> Run | None:
    """The parent run of a sweep, if it ever began."""
    found = client.search_runs(
        [experiment_id],
        f"tags.sweep = '{sweep.name}' and tags.hash = '{sweep.hash}'",
        order_by=["created ASC"],
        max_results=1,
    )
    return found[0] if found else None


def of_sweep(client: MlflowClient, experiment_id: str, parent: str, sweep: Sweep) -> pd.DataFrame:
    """The trials that are finished or raised, in the sweep's order; no trial twice, none that it has not."""
    rows: dict[str, dict[str, Any]] = {}
    planned = [trial.hash for trial in sweep.trials]
    wanted = set(planned)
    for run in children(client, experiment_id, parent):
        if run.info.status in ("FINISHED", "FAILED") and run.data.tags.get("hash") in wanted:
            row = _row_of_run(run)
            if row["hash"] not in rows or rows[row["hash"]]["outcome"] == "error":
                rows[row["hash"]] = row
    return frame([rows[identity] for identity in planned if identity in rows], sweep)


def rows(trials: pd.DataFrame) -> str:
    """Trials as the CSV that `published` reads."""
    return trials.drop(columns="run_id").to_csv(index=False, float_format=f"%.{DIGITS}g")


def published(sweep: Sweep) -> pd.DataFrame:
    """The trials of a sweep that `sweeps/results` holds, without `run_id`: the store is not published.

    Raises
    ------
    ConfigError
        If there are none, or their file lacks a column.
    """
    path = shipped("sweeps") / "results" / sweep.name / "trials.csv"
    names = [axis.name for axis in sweep.axes]
    if not path.is_file():
        raise ConfigError("sweep", f"{sweep.name} has no published results")
    numbers = (*COUNTS, "seconds")
    types = {**dict.fromkeys(names, str), **dict.fromkeys(numbers, float)}
    blanks = {name: [""] for name in numbers}
    found = pd.read_csv(path, dtype=types, keep_default_na=False, na_values=blanks)
    lacking = {*names, *COLUMNS[:-1]} - set(found)
    if lacking:
        raise ConfigError(path.name, f"lacks {', '.join(sorted(lacking))}")
    return found[[*names, *COLUMNS[:-1]]]


def frame(rows: Sequence[Mapping[Any, Any]], sweep: Sweep) -> pd.DataFrame:
    """Rows of trials as a DataFrame, its columns complete even without rows."""
    return pd.DataFrame(list(rows), columns=[*(axis.name for axis in sweep.axes), *COLUMNS])


def _row_of_run(run: Run) -> dict[str, Any]:
    """A trial, as its run has it."""
    tags, metrics, params = run.data.tags, run.data.metrics, run.data.params
    most = int(params["method.max_iterations"])
    each = int(params.get("method.experiments", 1))
    outcome = tags["outcome"]
    return {
        **{key.removeprefix(AXIS): value for key, value in tags.items() if key.startswith(AXIS)},
        "hash": tags["hash"],
        "repetition": int(tags["repetition"]),
        "seed": int(params["seed"]),
        "outcome": outcome,
        "experiments": _until_success(outcome, metrics.get("experiments/total", 0), most * each),
        "iterations": _until_success(outcome, metrics.get("experiments/iterations", 0), most),
        "seconds": (run.info.end_time - run.info.start_time) / 1000,
        "raised": tags.get("error", ""),
        "run_id": run.info.run_id,
    }


def row_of_record(trial: Trial, record: TrialRecord, study: Study, sweep: Sweep) -> dict[str, Any]:
    """A trial, as its record has it."""
    outcome = "error" if record.error else "succeeded" if record.succeeded else "not succeeded"
    most, each = study.method.max_iterations, getattr(study.method, "experiments", 1)
    total = record.iterations[-1].total_experiments if record.iterations else 0
    return {
        **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
        "hash": trial.hash,
        "repetition": trial.repetition,
        "seed": trial.seed,
        "outcome": outcome,
        "experiments": _until_success(outcome, total, most * each),
        "iterations": _until_success(outcome, len(record.iterations), most),
        "seconds": record.seconds,
        "raised": record.error or "",
        "run_id": "",
    }


def _until_success(outcome: str, made: float, most: int) -> float:
    """How many experiments or iterations a trial counts: one that never succeeds counts all it may make."""
    if outcome == "error":
        return float("nan")
    return float(made if outcome == "succeeded" else max(made, most))
