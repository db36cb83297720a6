"""How far from their goal the policies are with which a sweep's trials ended.

`python sweeps/studies/goal_errors.py SWEEP FILE`, beside the folder `trials`, writes a row of the file for
each finished trial of a sweep whose last policies were tested, and prints a table. An error is the root mean
square, over a test episode, of the distance from the goal, whose quantities have one unit; a trial's is the
mean over its test episodes, of those that failed while they lasted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from simbias.core import markdown
from simbias.sweep import results, statistics
from simbias.sweep.grid import Sweep, expand
from simbias.trial.folder import EPISODES

TRIALS = Path("trials")
HEAD = ["trials", "RMS error (mm)", "least to most", "times less than the last row's", "failed episodes"]


def errors_of(row: dict[Any, Any], axes: list[str]) -> dict[str, Any]:
    """A trial's errors in its test episodes."""
    episodes = pd.read_csv(TRIALS / row["hash"] / EPISODES)
    distances = np.sqrt(np.square(episodes.filter(like="_rms_error")).sum(axis=1))
    own = {name: row[name] for name in (*axes, "repetition", "outcome", "experiments")}
    failed = int(episodes["failure"].notna().sum())
    return own | {"error": distances.mean(), "largest": distances.max(), "failed": failed}


def table(sweep: Sweep, errors: pd.DataFrame) -> str:
    """A row for each cell, in markdown: means over its trials, with their bootstrap intervals."""
    axes = [axis.name for axis in sweep.axes]
    groups, body = errors.groupby(axes), []
    for cell in sweep.cells:
        own, last = (
            groups.get_group(cell.labels),
            groups.get_group((*cell.labels[:-1], sweep.axes[-1].labels[-1])),
        )
        ratios = last["error"].to_numpy() / own["error"].to_numpy()  # of pairs
        spread = f"{1000 * own['error'].min():.1f} to {1000 * own['error'].max():.1f}"
        texts = [str(len(own)), _mean(1000 * own["error"]), spread, _mean(ratios), str(own["failed"].sum())]
        body.append([*cell.labels, *texts])
    return markdown.table([*axes, *HEAD], body)


def _mean(values: Any) -> str:
    """A mean and its interval."""
    low, high = statistics.interval(list(values))
    return f"{np.mean(values):.1f} [{low:.1f}, {high:.1f}]"


def main(name: str, path: Path) -> None:
    """Write the file and print the table."""
    sweep = expand([f"+sweep={name}"])
    axes = [axis.name for axis in sweep.axes]
    trials = results.of_folders(sweep, TRIALS).query("outcome != 'error'")
    errors = pd.DataFrame([errors_of(row, axes) for row in trials.to_dict("records")])
    errors.to_csv(path, index=False, float_format="%.6g", lineterminator="\n")
    print(table(sweep, errors), end="")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
