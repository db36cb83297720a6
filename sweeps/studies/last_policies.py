"""How often the policies with which a sweep's trials ended balance the hardware.

`python sweeps/studies/last_policies.py NAME FILE`, beside the folder `trials`, tests the last policy of each
finished trial of `+sweep=NAME` in 20 episodes, writes a row of the file for it and prints the sweep's table
with them. It is for sweeps that ran without `policy_test.episodes=20`, which does the same.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Parallel, delayed
from premise import STARTS, balanced_starts

import simbias
from simbias.core import markdown
from simbias.sweep import results, statistics, tables
from simbias.sweep.grid import Sweep, expand

TRIALS = Path("trials")


def finished(sweep: Sweep) -> pd.DataFrame:
    """A row for each trial of `TRIALS` that ended without an error; one line if a cell has none."""
    trials = results.of_folders(sweep, TRIALS).query("outcome != 'error'")
    labels = set(trials[[axis.name for axis in sweep.axes]].itertuples(index=False, name=None))
    for cell in sweep.cells:
        if cell.labels not in labels:
            sys.exit(f"{TRIALS}: no finished trial of {sweep.name}, {', '.join(cell.labels)}")
    return trials


def outcome_of(row: dict[Any, Any], axes: list[str]) -> dict[str, Any]:
    """A trial's last policy, tried."""
    trial = simbias.load_trial(TRIALS / row["hash"])
    balanced = balanced_starts(trial.study, trial.iterations[-1].parameters)
    own = {name: row[name] for name in (*axes, "repetition", "outcome")}
    return own | {"balanced": balanced, "starts": STARTS}


def table(sweep: Sweep, trials: pd.DataFrame, policies: pd.DataFrame) -> str:
    """The sweep's table, in markdown, and the mean share of starts that a cell's last policies balance."""
    laid = tables.layout(tables.cells(trials, sweep), sweep)
    axes = [axis.name for axis in sweep.axes]
    shares = policies.assign(share=policies["balanced"] / policies["starts"]).groupby(axes)["share"]
    texts = [statistics.mean_text(shares.get_group(cell.labels), ".0%") for cell in sweep.cells]
    body = [[*line, text] for line, text in zip(laid.body, texts, strict=True)]
    return markdown.table([*laid.head, "starts that the last policy balances"], body)


def main(name: str, path: Path) -> None:
    """Try all policies, write the file, and print the table."""
    sweep = expand([f"+sweep={name}"])
    if sweep.report.columns is not None:
        sys.exit(f"{name} has cells side by side")
    axes = [axis.name for axis in sweep.axes]
    trials = finished(sweep)
    rows = Parallel(n_jobs=2)(delayed(outcome_of)(row, axes) for row in trials.to_dict("records"))
    policies = pd.DataFrame(rows)
    policies.to_csv(path, index=False, lineterminator="\n")
    print(table(sweep, trials, policies), end="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name")
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    main(arguments.name, arguments.file)
