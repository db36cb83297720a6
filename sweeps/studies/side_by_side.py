"""README's Table II: the paper's numbers, its method here, and the composition that saves experiments.

`python sweeps/studies/side_by_side.py` prints it, from the published trials of both sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from simbias.core import markdown
from simbias.sweep import results, tables
from simbias.sweep.grid import Sweep, expand

MEASURES = ("paper", "its method here", "ours", "our iterations")


def side_by_side() -> str:
    """The cells of both sweeps, in markdown."""
    sweep = expand(["+sweep=table2"])
    theirs, ours = cells(sweep), cells(expand(["+sweep=table2_robust"]))

    def texts(labels: tuple[str, ...]) -> list[str]:
        paper, iterations = (tables.TEXTS[name] for name in ("paper", "iterations"))
        its, own = theirs[labels], ours[labels]
        return [paper(its), experiments(its), experiments(own), iterations(own)]

    return markdown.table(*tables.arrange(sweep, MEASURES, texts))


def cells(sweep: Sweep) -> dict[tuple[str, ...], Mapping[Any, Any]]:
    """The published cells of a sweep by their labels."""
    rows = tables.cells(results.published(sweep), sweep).to_dict("records")
    return dict(zip((cell.labels for cell in sweep.cells), rows, strict=True))


def experiments(row: Mapping[Any, Any]) -> str:
    """Mean, interval, and how many trials succeeded."""
    return " ".join(tables.TEXTS[name](row) for name in ("experiments", "succeeded"))


if __name__ == "__main__":
    print(side_by_side(), end="")
