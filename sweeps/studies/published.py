"""Are the published trials of a sweep those that it runs today?

`python sweeps/studies/published.py SWEEP ... [--trials 1] [--out FILE]` runs the first trials of each cell
again, and compares each with the published one: outcome, experiments, iterations, time on the hardware and,
if both were tested, the episodes of their last policies. The exit status is 0 if all agree. FILE gets a row
for each trial.
"""

from __future__ import annotations

import argparse
import sys

import pandas as pd

import simbias
from simbias.sweep.grid import expand
from simbias.sweep.results import published

SAME = ("outcome", "experiments", "iterations", "test_episodes", "hardware_seconds")


def compared(name: str, trials: int) -> pd.DataFrame:
    """A row for each trial that was run again: published and new values, and whether they are the same."""
    overrides = [f"+sweep={name}", f"sweep.trials={trials}"]
    new = simbias.run_sweep([*overrides, "tracking=folders", "tracking.pictures=false"])
    before = published(expand([f"+sweep={name}"])).set_index("hash").loc[new["hash"]].reset_index()
    rows = pd.DataFrame({"sweep": name, "hash": new["hash"], "repetition": new["repetition"]})
    same = pd.Series(True, index=new.index)
    for column in SAME:
        old, now = before[column], new[column]
        if column == "hardware_seconds":
            agree = old.isna() | ((old - now).abs() <= 1e-3 * old.abs())  # four digits are published
        elif column == "test_episodes":
            agree = (old == "") | (now == "") | (old == now)  # tested on one side alone
        else:
            agree = old == now
        rows[f"{column}_published"], rows[column] = old, now
        same &= agree
    return rows.assign(same=same, seconds_published=before["seconds"], seconds=new["seconds"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sweeps", nargs="+")
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--out")
    parsed = parser.parse_args()
    tables = []
    for name in parsed.sweeps:
        tables.append(compared(name, parsed.trials))
        table = tables[-1]
        print(f"{name}: {table['same'].sum()} of {len(table)} trials are the published ones", flush=True)
        if not table["same"].all():
            print(table[~table["same"]].to_string())
    found = pd.concat(tables)
    if parsed.out:
        found.to_csv(parsed.out, index=False, float_format="%.4g")
    return int(not found["same"].all())


if __name__ == "__main__":
    sys.exit(main())
