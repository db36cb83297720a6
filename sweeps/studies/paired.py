"""What the points of an axis differ by, pair by pair, where their trials met the same seeds.

`python sweeps/studies/paired.py SWEEP AXIS [--by AXIS]` compares every point of an axis with its first one,
in the published trials of a sweep that has the axis among its `common_seeds`, or in those of your own one, if
SWEEP is its `trials.csv`; for each point of another axis apart, if one is named. A trial that never succeeds
counts all experiments that it may make, and a line says if this differs between trials; one that raised an
error is left out, with its pairs.
"""

from __future__ import annotations

import argparse
from itertools import takewhile
from pathlib import Path

import pandas as pd

from simbias.config import ConfigError
from simbias.sweep import results
from simbias.sweep.grid import expand
from simbias.sweep.tables import failures, left_out, share

HEAD = (
    "experiments",
    "difference, standard error",
    "pairs that differ",
    "iterations",
    "succeeded",
    "seconds",
)


def paired(name: str, axis: str, by: str | None = None) -> str:
    """A row for every point of the axis, in markdown; beneath, how many trials are left out.

    Raises
    ------
    ConfigError
        If there is no such sweep, an axis is none of it, or trials have other seeds at its points.
    """
    if name.endswith(".csv"):
        head = pd.read_csv(name, nrows=0).columns
        axes = [*takewhile(lambda column: column != "hash", head)]
        trials = results.read(Path(name), axes)
    else:
        sweep = expand([f"+sweep={name}"])
        axes, trials = [each.name for each in sweep.axes], results.published(sweep)
    for given in filter(None, (axis, by)):
        if given not in axes:
            raise ConfigError("", f"no such axis: {given}; there are {', '.join(axes)}")
    keys = [*(each for each in axes if each != axis), "repetition"]
    groups = list(trials.groupby(by, sort=False)) if by else [("", trials)]
    names = [*([by] if by else []), axis]
    lines = [
        f"| {' | '.join([*names, *HEAD])} |",
        f"| {' | '.join([':--'] * len(names) + ['--:'] * len(HEAD))} |",
    ]
    for group, own in groups:
        points = {point: trials.set_index(keys) for point, trials in own.groupby(axis, sort=False)}
        first = next(iter(points.values()))
        if any((first["seed"] - these["seed"]).any() for these in points.values()):
            raise ConfigError("", f"trials are not paired: {axis} is not among the sweep's common_seeds")
        for point, these in points.items():
            cells = [
                *([str(group)] if by else []),
                str(point),
                *row(these, None if these is first else first),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    if failing := failures(trials):
        lines += ["", f"A trial that never succeeds counts all experiments that it may make{failing}."]
    if missing := left_out(trials["outcome"]):
        lines += ["", missing.strip()]
    return "\n".join(lines) + "\n"


def row(trials: pd.DataFrame, reference: pd.DataFrame | None) -> list[str]:
    """What a point's trials needed, and by how much more than the reference's."""
    trials = trials[trials["outcome"] != "error"]
    difference = differing = ""
    if reference is not None:
        pairs = (trials["experiments"] - reference["experiments"]).dropna()
        difference = f"{pairs.mean():.2f}, {pairs.sem():.2f}"
        differing = f"{int((pairs != 0).sum())} of {len(pairs)}"
    succeeded = int((trials["outcome"] == "succeeded").sum())
    return [
        f"{trials['experiments'].mean():.2f}",
        difference,
        differing,
        f"{trials['iterations'].mean():.2f}",
        share(succeeded, len(trials)),
        f"{trials['seconds'].mean():.1f}",
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweep")
    parser.add_argument("axis")
    parser.add_argument("--by", metavar="AXIS")
    arguments = parser.parse_args()
    try:
        print(paired(arguments.sweep, arguments.axis, arguments.by), end="")
    except (ConfigError, OSError) as error:
        parser.error(str(error))
