"""README's Table II: the paper's numbers, its method here, and the composition that saves experiments.

`python tests/studies/side_by_side.py` prints it, from the published trials of both sweeps.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from simbias import results, tables
from simbias.grid import Sweep, expand

MEASURES = ("paper", "its method here", "ours", "our iterations")


def side_by_side() -> str:
    """The cells of both sweeps, in markdown."""
    sweep = expand(["+sweep=table2"])
    theirs, ours = cells(sweep), cells(expand(["+sweep=table2_robust"]))

    def texts(labels: tuple[str, ...]) -> list[str]:
        row = ours[labels]
        paper = f"{theirs[labels]['paper']:.1f}"
        return [paper, experiments(theirs[labels]), experiments(row), f"{row['iterations']:.1f}"]

    return tables.markdown(tables.arranged(sweep, MEASURES, texts))


def cells(sweep: Sweep) -> dict[tuple[str, ...], Mapping[Any, Any]]:
    """The published cells of a sweep by their labels."""
    rows = tables.cells(results.published(sweep), sweep).to_dict("records")
    return dict(zip((cell.labels for cell in sweep.cells), rows, strict=True))


def experiments(row: Mapping[Any, Any]) -> str:
    """Mean, interval, and how many trials succeeded."""
    return f"{row['mean']:.1f} [{row['low']:.1f}, {row['high']:.1f}] {row['succeeded']}/{row['trials']}"


if __name__ == "__main__":
    print(side_by_side(), end="")
