"""What a sweep's trials found, read back from the store as a DataFrame.

A DataFrame of trials has a row for each, with a column for each of the sweep's axes and `hash`,
`repetition`, `seed`, `outcome` (`succeeded`, `not succeeded` or `error`), `experiments` (hardware experiments
until success; without it all that the method may make, 2 x N_out = 20 by Table I), `iterations` (likewise),
`seconds` (it computed), `hardware_seconds` (its experiments lasted), `raised` (what it raised) and `run_id`.
Where its last policy was tried from held-out starts, `held_out` has a 1 for each from which it holds for the
task's horizon and a 0 for each other, `lasted` is the share of those that went on and lasted, and
`lasted_seconds` how long these did on average.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import nan
from typing import TYPE_CHECKING, Any

import pandas as pd

from simbias.config.resources import resource_folder
from simbias.core.errors import ConfigError
from simbias.mlflow.fields import HELD_OUT
from simbias.mlflow.rows import FINISHED, RunRow, is_whole
from simbias.trial.run import Outcome

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from simbias.sweep.grid import Sweep, Trial

DIGITS = 4  # of times in published results
COUNTS = ("experiments", "iterations")
ENDED = (FINISHED, "FAILED")  # states of runs that tables tell of,
TOLD = (Outcome.SUCCEEDED, Outcome.NOT_SUCCEEDED, Outcome.ERROR)  # and their outcomes
LATER = ("hardware_seconds", "held_out", "lasted", "lasted_seconds")  # that earlier results lack
COLUMNS = ("hash", "repetition", "seed", "outcome", *COUNTS, "seconds", *LATER, "raised", "run_id")


def find_sweep(client: MlflowClient, experiment_id: str, sweep: Sweep) -> Run | None:
    """The parent run of a sweep, if it ever began; its hash is also of its name, which may have quotes."""
    runs = client.search_runs([experiment_id], f"tags.hash = '{sweep.hash}'", order_by=["created ASC"])
    return next((run for run in runs if "sweep" in run.data.tags), None)


def of_sweep(runs: Iterable[RunRow], sweep: Sweep) -> pd.DataFrame:
    """The trials that came to an end or raised, in the sweep's order; none twice, none that it has not."""
    planned = {trial.hash: trial for trial in sweep.trials}
    rows: dict[str, dict[str, Any]] = {}
    for run in runs:
        trial, outcome = planned.get(run.tags.get("hash", "")), run.tags.get("outcome")
        if not is_whole(run) or trial is None or run.status not in ENDED or outcome not in TOLD:
            continue
        if trial.hash not in rows or rows[trial.hash]["outcome"] == Outcome.ERROR:
            raised, held_out = run.tags.get("error", ""), run.tags.get(HELD_OUT, "")
            rows[trial.hash] = row(trial, sweep, str(outcome), run.metrics, raised, run.run_id, held_out)
    return in_order(rows, sweep)


def in_order(rows: Mapping[str, Mapping[Any, Any]], sweep: Sweep) -> pd.DataFrame:
    """Rows of trials, by hash, in the sweep's order."""
    return frame([rows[trial.hash] for trial in sweep.trials if trial.hash in rows], sweep)


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
    path = resource_folder("sweeps") / "results" / sweep.name / "trials.csv"
    names = [axis.name for axis in sweep.axes]
    if not path.is_file():
        raise ConfigError("sweep", f"{sweep.name} has no published results")
    numbers = (*COUNTS, "seconds", *(name for name in LATER if name != HELD_OUT))
    types = {**dict.fromkeys((*names, HELD_OUT), str), **dict.fromkeys(numbers, float)}
    blanks = {name: [""] for name in numbers}
    trials = pd.read_csv(path, dtype=types, keep_default_na=False, na_values=blanks)
    for name in set(LATER) - set(trials):
        trials[name] = "" if name == HELD_OUT else nan
    lacking = {*names, *COLUMNS[:-1]} - set(trials)
    if lacking:
        raise ConfigError(path.name, f"lacks {', '.join(sorted(lacking))}")
    return trials[[*names, *COLUMNS[:-1]]]


def frame(rows: Sequence[Mapping[Any, Any]], sweep: Sweep) -> pd.DataFrame:
    """Rows of trials as a DataFrame, its columns complete even without rows."""
    return pd.DataFrame(list(rows), columns=[*(axis.name for axis in sweep.axes), *COLUMNS])


def row(
    trial: Trial,
    sweep: Sweep,
    outcome: str,
    numbers: Mapping[str, float],
    raised: str = "",
    run_id: str = "",
    held_out: str = "",
) -> dict[str, Any]:
    """A trial's row, from what `simbias.mlflow.fields` tells of its record: `trial_metrics` and `holds`."""
    return {
        **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
        "hash": trial.hash,
        "repetition": trial.repetition,
        "seed": trial.seed,
        "outcome": outcome,
        "experiments": numbers.get("trial/experiments", nan),
        "iterations": numbers.get("trial/iterations", nan),
        "seconds": numbers.get("trial/seconds", nan),
        "hardware_seconds": numbers.get("trial/hardware_seconds", nan),
        "held_out": held_out,
        "lasted": numbers.get("held_out/lasted", nan),
        "lasted_seconds": numbers.get("held_out/seconds", nan),
        "raised": raised,
        "run_id": run_id,
    }
