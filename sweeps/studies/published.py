"""Are the published trials of a sweep those that it runs today, and what do their last policies hold?

`python sweeps/studies/published.py SWEEP ... [--trials 1] [--episodes 20] [--out FILE]` runs the first trials
of each cell again, and compares each with the published one: outcome, experiments, iterations, time on the
hardware and, if both were tested, the episodes of their last policies. The exit status is 0 if all agree.
FILE gets a row for each trial. With `--episodes`, last policies are tested, in two of the episodes for a
minute, and a table tells what they hold.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import pandas as pd

import simbias
from simbias.core import markdown
from simbias.core.proportions import counted_share
from simbias.sweep import statistics
from simbias.sweep.grid import expand
from simbias.sweep.results import published

SAME = ("outcome", "experiments", "iterations", "test_episodes", "hardware_seconds")
HEAD = ("sweep", "trials", "share of 20 starts that they hold", "hold 18 of 20 starts", "last a minute twice")
HEAD += ("trials that succeed", "share that these hold")


def compared(name: str, trials: int, episodes: int) -> pd.DataFrame:
    """A row for each trial that was run again: published and new values, and whether they are the same."""
    settings = [f"sweep.trials={trials}", *[f"policy_test.episodes={episodes}"] * (episodes > 0)]
    new = simbias.run_sweep([f"+sweep={name}", *settings, "tracking=folders", "tracking.pictures=false"])
    sweep = expand([f"+sweep={name}"])
    before = published(sweep).set_index("hash").loc[new["hash"]].reset_index()
    cells = [" ".join(labels) for labels in new[[axis.name for axis in sweep.axes]].to_numpy().tolist()]
    rows = pd.DataFrame({"sweep": name, "cell": cells, "hash": new["hash"], "repetition": new["repetition"]})
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
    rows["long_success_rate"], rows["long_seconds"] = new["long_success_rate"], new["long_seconds"]
    return rows.assign(same=same, seconds_published=before["seconds"], seconds=new["seconds"])


def held(rows: pd.DataFrame) -> Iterator[list[str]]:
    """Of each sweep: the mean share of test episodes, how many policies hold nine in ten, and a minute."""
    for name, tested in rows.groupby("sweep", sort=False):
        shares = tested["test_episodes"].map(lambda episodes: episodes.count("1") / len(episodes))
        succeeded = shares[tested["outcome"] == "succeeded"]
        n, counts = len(tested), [(shares >= 0.9).sum(), (tested["long_success_rate"] == 1).sum()]
        means = [statistics.mean_text(some.tolist(), ".0%") for some in (shares, succeeded)]
        counted = [counted_share(int(k), n) for k in counts]
        yield [str(name), str(n), means[0], *counted, str(len(succeeded)), means[1]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sweeps", nargs="+")
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=0, help="test episodes of each last policy")
    parser.add_argument("--out")
    parsed = parser.parse_args()
    tables = []
    for name in parsed.sweeps:
        tables.append(compared(name, parsed.trials, parsed.episodes))
        table = tables[-1]
        print(f"{name}: {table['same'].sum()} of {len(table)} trials are the published ones", flush=True)
        if not table["same"].all():
            print(table[~table["same"]].to_string())
    found = pd.concat(tables)
    if parsed.out:
        found.to_csv(parsed.out, index=False, float_format="%.4g")
    if parsed.episodes:
        print(markdown.table(HEAD, held(found)), end="")
    return int(not found["same"].all())


if __name__ == "__main__":
    sys.exit(main())
