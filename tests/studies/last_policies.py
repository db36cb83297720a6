"""How often the policies with which a sweep's trials ended balance the hardware.

`python tests/studies/last_policies.py NAME FILE`, in the folder of the store, tries the last policy of every
finished trial of `+sweep=NAME` from 20 random starts, the same for all, and writes a row for each to the file.
A trial may succeed by luck, with two starts that its policy holds; this tells what the policy is worth.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Parallel, delayed

import simbias
from simbias.grid import expand
from simbias.recorded import load_trial
from simbias.tables import interval
from studies.premise import STARTS, balanced_starts


def tried(row: dict[Any, Any], axes: list[str]) -> dict[str, Any]:
    """A trial's last policy, tried."""
    trial = load_trial(row["run_id"])
    balanced = balanced_starts(trial.study, trial.iterations[-1].optimum.parameters)
    told = {name: row[name] for name in (*axes, "repetition", "outcome")}
    return told | {"balanced": balanced, "starts": STARTS}


def main(name: str, path: Path) -> None:
    """Try all policies, write the file, and print each cell's mean."""
    sweep = expand([f"+sweep={name}"])
    axes = [axis.name for axis in sweep.axes]
    trials = simbias.load([]).tracking.finished(sweep).to_dict("records")
    rows = pd.DataFrame(Parallel(n_jobs=2)(delayed(tried)(row, axes) for row in trials))
    rows.to_csv(path, index=False, lineterminator="\n")
    for cell, own in rows.groupby(axes, sort=False)["balanced"]:
        low, high = interval(list(own / STARTS))
        print(f"{' '.join(cell)}: {own.mean() / STARTS:.0%} [{low:.0%}, {high:.0%}] of {len(own)} policies' starts")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
