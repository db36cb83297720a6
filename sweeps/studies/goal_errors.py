"""How far from their goal the policies are with which a sweep's trials ended.

`python sweeps/studies/goal_errors.py SWEEP FILE RIVAL ...`, beside the folder `trials`, writes a row of the
file for each finished trial of a sweep whose last policies were tested. It prints a table, with how many
times less errors are than those of rivals, labels of the last axis. An error is the root mean square, over a
test episode, of the distance from the goal, whose quantities have one unit; a trial's is the mean over its
test episodes, of those that failed while they lasted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from last_policies import TRIALS, finished

from simbias.core import markdown
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.statistics import mean_text
from simbias.trial.folder import EPISODES

HEAD = ["trials", "that differ", "RMS error (mm)", "least to most", "failed episodes"]


def errors_of(row: dict[Any, Any], axes: list[str]) -> dict[str, Any]:
    """A trial's errors in its test episodes."""
    episodes = pd.read_csv(TRIALS / row["hash"] / EPISODES)
    distances = np.sqrt(np.square(episodes.filter(like="_rms_error")).sum(axis=1))
    own = {name: row[name] for name in (*axes, "repetition", "outcome", "experiments")}
    failed = int(episodes["failure"].notna().sum())
    return own | {"error": distances.mean(), "largest": distances.max(), "failed": failed}


def table(sweep: Sweep, errors: pd.DataFrame, rivals: Sequence[str]) -> str:
    """A row for each cell, in markdown: means over trials, intervals where no two are alike."""
    axes, body = [axis.name for axis in sweep.axes], []
    of_cell = {labels: own.set_index("repetition") for labels, own in errors.groupby(axes)}
    for cell in sweep.cells:
        own = of_cell[cell.labels]
        mm = 1000 * own["error"]
        span, failed = f"{mm.min():.1f} to {mm.max():.1f}", str(own["failed"].sum())
        times = (_mean(of_cell[*cell.labels[:-1], rival]["error"], own["error"]) for rival in rivals)
        differ = str(mm.nunique())
        body.append([*cell.labels, str(len(own)), differ, _mean(mm), span, failed, *times])
    return markdown.table([*axes, *HEAD, *(f"times less: {rival}" for rival in rivals)], body)


def _mean(errors: pd.Series, over: pd.Series | float = 1.0) -> str:
    """Their mean, with an interval if the errors are of as many policies; copies would make it too narrow."""
    ratios = errors / over
    return mean_text(ratios, ".1f") if errors.is_unique else f"{ratios.mean():.1f}"


def main(name: str, path: Path, *rivals: str) -> None:
    """Write the file and print the table."""
    sweep = expand([f"+sweep={name}"])
    axes = [axis.name for axis in sweep.axes]
    errors = pd.DataFrame([errors_of(row, axes) for row in finished(sweep).to_dict("records")])
    errors.to_csv(path, index=False, float_format="%.6g", lineterminator="\n")
    print(table(sweep, errors, rivals), end="")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
