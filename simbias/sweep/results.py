"""The trials of a sweep as a DataFrame, read from their folders or from published results.

It has a row for each trial, with a column for each of the sweep's axes and `hash`, `repetition`, `seed`,
`outcome` (`succeeded`, `not succeeded` or `error`), `experiments` (hardware experiments until success;
without success the most that method and budget allow, 2 x N_out = 20 by Table I, or those made if the
budget's seconds were spent), `iterations` (until success; without success the method's maximum), `seconds`
(wall time), `hardware_seconds` (duration of the experiments, even without success) and `raised` (its error).
`policy` is a digest of its last policy's parameters. If that was tested, `test_episodes` has a 1 for each
successful episode and a 0 for each other, and `lasting_episodes` a 1 for each that lasts to its own end;
`long_success_rate` is the share of long episodes that last to their end, and `long_seconds` the mean
duration of all long episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan
from pathlib import Path
from typing import Any

import pandas as pd

from simbias.config.resources import resource_folder
from simbias.core.digest import short_digest
from simbias.core.errors import ConfigError
from simbias.sweep.grid import Sweep, Trial
from simbias.trial.folder import TrialFolder
from simbias.trial.summary import Outcome, TrialSummary

DIGITS = 4  # of times in published results
OF_POLICY = 7  # digits of the last policy's hash: two of 1000 policies share them once in 500 sweeps
COUNTS = ("experiments", "iterations")
SHOWN = (Outcome.SUCCEEDED, Outcome.NOT_SUCCEEDED, Outcome.ERROR)  # outcomes of trials in tables
TEXTS = ("test_episodes", "lasting_episodes", "policy")
# Columns that some published results lack, and their default values.
LATER: Mapping[str, Any] = {
    "hardware_seconds": nan,
    **dict.fromkeys(TEXTS, ""),
    "long_success_rate": nan,
    "long_seconds": nan,
}
COLUMNS = ("hash", "repetition", "seed", "outcome", *COUNTS, "seconds", *LATER, "raised")


def of_folders(
    sweep: Sweep, trials: Path | None, damaged: Callable[[ConfigError], object] = lambda error: None
) -> pd.DataFrame:
    """The trials that ended or raised an error, in the sweep's order; empty without a folder.

    An unreadable folder, or one of another trial, is ignored; `damaged` is called with the error that names
    it.
    """
    rows = {}
    for trial in sweep.trials if trials else ():
        folder = TrialFolder(Path(trials or "", trial.hash))
        try:
            summary = folder.summary()
            if summary is not None and summary.outcome in SHOWN:
                folder.check_identity(trial.hash)
                rows[trial.hash] = row(trial, sweep, summary)
        except ConfigError as error:
            damaged(error)
    return in_order(rows, sweep)


def in_order(rows: Mapping[str, Mapping[Any, Any]], sweep: Sweep) -> pd.DataFrame:
    """Rows of trials, by hash, in the sweep's order."""
    ordered = [rows[trial.hash] for trial in sweep.trials if trial.hash in rows]
    return pd.DataFrame(ordered, columns=[*(axis.name for axis in sweep.axes), *COLUMNS])


def row(trial: Trial, sweep: Sweep, summary: TrialSummary) -> dict[str, Any]:
    """A trial's row."""
    return {
        **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
        "hash": trial.hash,
        "repetition": trial.repetition,
        "seed": trial.seed,
        **numbers(summary),
        "raised": summary.stopped_by,
    }


def numbers(summary: TrialSummary) -> dict[str, Any]:
    """The columns of a trial's row about its outcome."""
    return {
        "outcome": str(summary.outcome),
        "experiments": summary.experiments_until_success,
        "iterations": summary.iterations_until_success,
        **{name: getattr(summary, name) for name in ("seconds", *LATER)},
        "policy": summary.policy[:OF_POLICY],
    }


def digest(rows: Mapping[str, Mapping[Any, Any]]) -> str:
    """A digest of the finished trials, by hash and in any order; it changes with any of their numbers."""
    ended = [{**rows[name], "hash": name} for name in sorted(rows) if Outcome(rows[name]["outcome"]).final]
    columns = ["hash", "outcome", *COUNTS, "seconds", *LATER]
    return short_digest(csv(pd.DataFrame(ended, columns=columns)).encode())


def csv(trials: pd.DataFrame) -> str:
    """Trials as CSV, which `published` reads."""
    return trials.to_csv(index=False, float_format=f"%.{DIGITS}g")


def published(sweep: Sweep, folder: str = "") -> pd.DataFrame:
    """The published trials of a sweep in `sweeps/results`, by default in a folder of the sweep's name.

    Raises
    ------
    ConfigError
        If there are none; others as for `read`.
    """
    path = resource_folder("sweeps") / "results" / (folder or sweep.name) / "trials.csv"
    if not path.is_file():
        raise ConfigError("sweep", f"{sweep.name} has no published results")
    return read(path, [axis.name for axis in sweep.axes])


def read(path: Path, names: Sequence[str]) -> pd.DataFrame:
    """The trials in a file written by `csv`; `names` are the axes' names.

    Raises
    ------
    ConfigError
        If it lacks a column.
    """
    numbers = (*COUNTS, "seconds", *(name for name in LATER if name not in TEXTS))
    types = {**dict.fromkeys((*names, *TEXTS), str), **dict.fromkeys(numbers, float)}
    blanks = {name: [""] for name in numbers}
    trials = pd.read_csv(path, dtype=types, keep_default_na=False, na_values=blanks)
    trials = trials.assign(**{name: blank for name, blank in LATER.items() if name not in trials})
    lacking = {*names, *COLUMNS} - set(trials)
    if lacking:
        raise ConfigError(path.name, f"lacks {', '.join(sorted(lacking))}")
    return trials[[*names, *COLUMNS]]
