"""How long a sweep may take."""

from __future__ import annotations

from statistics import mean

from pandas import DataFrame

from simbias.sweep.grid import Sweep


def seconds_left(sweep: Sweep, finished: DataFrame, n_jobs: int) -> float | None:
    """Seconds that the missing trials may take, by those that are finished; None if none is.

    A trial is taken to last as long as those of its cell or, where none of them is finished, of all cells.
    """
    if finished.empty:
        return None
    seconds: dict[tuple[str, ...], list[float]] = {}
    for row in finished.to_dict("records"):
        seconds.setdefault(tuple(row[axis.name] for axis in sweep.axes), []).append(row["seconds"])
    overall, done = list(finished["seconds"]), set(finished["hash"])
    missing = (trial for trial in sweep.trials if trial.hash not in done)
    return sum(mean(seconds.get(trial.cell.labels, overall)) for trial in missing) / n_jobs
