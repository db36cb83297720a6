"""A method against its rivals on a suite, where a cell's mean counts once.

`python sweeps/studies/cells_compared.py FOLDER METHOD RIVAL ...` reads the published trials in FOLDER. It
prints the scores of all methods in each cell, and the comparisons. A score is the mean share of test episodes
that a cell's last policies last; a trial that raised an error is left out. A comparison is an exact two-sided
sign test of the cells' differences, Holm over the rivals, and the mean difference with a bootstrap over
cells.
`--unheld NAME` adds the mean scores over the cells in which not all trials of this method hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from simbias.core import markdown
from simbias.core.proportions import wilson
from simbias.sweep.statistics import holds, holm, mean_text, passed, sign_test
from simbias.sweep.tables import left_out

DIGITS = 9  # of a difference: beyond, it is rounding, and cells are equal
HEAD = ["rival", "cells better, worse, equal", "p", "p, Holm", "mean difference", "worst cell"]


def read(file: Path) -> pd.DataFrame:
    """Trials with `passed` of `episodes`, `score` and `holds`."""
    texts = {"lasting_episodes": str, "test_episodes": str}
    trials = pd.read_csv(file, dtype=texts, keep_default_na=False, na_values={"experiments": [""]})
    both = zip(trials["test_episodes"], trials["lasting_episodes"], strict=True)
    tests = pd.Series([passed(*each) for each in both], trials.index, dtype=str)
    successes, episodes = tests.str.count("1"), tests.str.len()
    score = (successes / episodes.where(episodes > 0)).fillna(0.0)
    return trials.assign(passed=successes, episodes=episodes, score=score, holds=tests.map(holds))


def scores(trials: pd.DataFrame) -> pd.DataFrame:
    """Mean scores, a row for each cell, a column for each method."""
    return trials.pivot_table(index="cell", columns="method", values="score", sort=False)


def comparisons(table: pd.DataFrame, method: str, rivals: Sequence[str]) -> Iterator[list[str]]:
    """A row for each rival."""
    differences = {rival: (table[method] - table[rival]).round(DIGITS) for rival in rivals}
    p = {rival: sign_test(each.tolist()) for rival, each in differences.items()}
    adjusted = holm(p)
    for rival, each in differences.items():
        yield [
            rival,
            ", ".join(str(int(some.sum())) for some in (each > 0, each < 0, each == 0)),
            f"{p[rival]:.3g}",
            f"{adjusted[rival]:.3g}",
            mean_text(each, "+.1%"),
            f"{each.min():+.0%}, {each.idxmin()}" if each.min() < 0 else "none",
        ]


def shortfalls(trials: pd.DataFrame, method: str) -> Iterator[str]:
    """Cells in which a rival's score is above the Wilson interval of the method's episodes."""
    own = trials[trials["method"] == method].groupby("cell", sort=False)[["passed", "episodes"]].sum()
    for cell, row in scores(trials).iterrows():
        high = wilson(int(own.loc[cell, "passed"]), int(own.loc[cell, "episodes"])).high
        for rival, score in row.drop(method).items():
            if score > high:
                yield f"{cell}, {rival} ({score:.0%} > {high:.0%})"


def report(trials: pd.DataFrame, method: str, rivals: Sequence[str], unheld: str | None = None) -> str:
    """All of it, in markdown."""
    missing, trials = left_out(trials["outcome"]), trials[trials["outcome"] != "error"]
    table, experiments = scores(trials), trials.groupby("method")["experiments"].mean()
    rows = {str(cell): row for cell, row in table.iterrows()} | {"mean": table.mean()}
    if unheld:
        held = trials[trials["method"] == unheld].groupby("cell", sort=False)["holds"].all()
        rows[f"mean of {int((~held).sum())} that {unheld} does not hold"] = table[~held].mean()
    body = [[name, *(f"{value:.0%}" for value in row)] for name, row in rows.items()]
    body.append(["experiments", *(f"{experiments[name]:.1f}" for name in table.columns)])
    return "\n".join(
        [
            markdown.table(["cell", *map(str, table.columns)], body),
            markdown.table(HEAD, list(comparisons(table, method, rivals))),
            f"Below a rival by more than its interval: {'; '.join(shortfalls(trials, method)) or 'nowhere'}."
            f"{missing}",
        ]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("method")
    parser.add_argument("rivals", nargs="+", metavar="rival")
    parser.add_argument("--unheld", metavar="NAME")
    given = parser.parse_args()
    print(report(read(given.folder / "trials.csv"), given.method, given.rivals, given.unheld))
