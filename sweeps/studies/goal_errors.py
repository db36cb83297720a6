"""How far from their goal the policies are with which a sweep's trials ended.

`python sweeps/studies/goal_errors.py SWEEP FILE RIVAL ...`, beside the folder `trials`, writes a row of the
file for each finished trial of a sweep whose last policies were tested, and draws them beside it. It prints
a table, with how many times less errors are than those of rivals, labels of the last axis. An error is the
root mean square, over a test episode, of the distance from the goal, whose quantities have one unit; a
trial's is the mean over its test episodes, of those that failed while they lasted.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from last_policies import TRIALS, finished
from matplotlib.figure import Figure

from simbias.core import markdown
from simbias.pictures.elements.dots import dot_marks, draw_dots
from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import HARDWARE, logarithmic, plain, save
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.statistics import mean_text
from simbias.trial.folder import EPISODES

HEAD = ["trials", "that differ", "RMS error (mm)", "least to most", "failed episodes"]
DOT, MARGIN = 0.07, 1.2  # of an error's logarithm, within which dots are spread; beside the extreme errors


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


def figure(sweep: Sweep, errors: pd.DataFrame) -> Figure:
    """Each trial's error, a row for each cell; the first axis' values have panels of their own."""
    outer, inner = sweep.axes
    made = Figure(figsize=(7.2, 0.3 * len(inner.labels) + 0.9), layout="constrained")
    all_axes, mm = made.subplots(1, len(outer.labels), sharex=True, sharey=True), 1000 * errors["error"]
    for axes, label in zip(all_axes, outer.labels, strict=True):
        for row, method in enumerate(inner.labels):
            own = (errors[outer.name] == label) & (errors[inner.name] == method)
            values, succeeded = mm[own].to_numpy(), errors["outcome"][own] == "succeeded"
            draw_dots(axes, row, values, succeeded.to_numpy(), HARDWARE, np.round(np.log(values) / DOT))
        axes.set(title=label, xlabel="RMS error (mm)")
        logarithmic(axes.xaxis)
        plain(axes, "x")
    axes.set_xlim(mm.min() / MARGIN, mm.max() * MARGIN)
    axes.set_yticks(range(len(inner.labels)), inner.labels)
    axes.set_ylim(len(inner.labels) - 0.4, -0.6)
    legend(made, dot_marks(HARDWARE))
    return made


def main(name: str, path: Path, *rivals: str) -> None:
    """Write the file and print the table."""
    sweep = expand([f"+sweep={name}"])
    axes = [axis.name for axis in sweep.axes]
    errors = pd.DataFrame([errors_of(row, axes) for row in finished(sweep).to_dict("records")])
    errors.to_csv(path, index=False, float_format="%.6g", lineterminator="\n")
    save(figure(sweep, errors), path.with_suffix(".png"))
    print(table(sweep, errors, rivals), end="")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweep")
    parser.add_argument("file", type=Path)
    parser.add_argument("rivals", nargs="*")
    arguments = parser.parse_args()
    main(arguments.sweep, arguments.file, *arguments.rivals)
