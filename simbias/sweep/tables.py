"""The table of a sweep: cells with their mean number of experiments, beside the paper's."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import zip_longest
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from simbias.core.markdown import text
from simbias.sweep.axes import Axis
from simbias.sweep.grid import Sweep

RESAMPLES = 10_000
AT_ONCE = 1_000_000  # numbers drawn, so that a large cell takes no more memory than a small one
CONFIDENCE = 0.95
BLANK = "–"  # noqa: RUF001  where there is no number
RELIABLE = 0.9  # success rate from which a policy counts as reliable
MEASURES = (
    *("trials", "succeeded", "raised", "mean", "low", "high", "iterations", "hardware_seconds"),
    *("success_rate", "reliable", "long_success_rate", "paper"),
)


class Layout(NamedTuple):
    """A table as text."""

    head: list[str]
    body: list[list[str]]


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Percentile bootstrap interval of the mean, whatever the values' order; nan for fewer than two."""
    return _interval(tuple(sorted(values))) if len(values) > 1 else (nan, nan)


@lru_cache(maxsize=1000)
def _interval(sample: tuple[float, ...]) -> tuple[float, float]:
    """Of values in order; notes, tables and figures of a sweep ask for the same ones."""
    rng, means = np.random.default_rng(0), np.empty(RESAMPLES)
    for some in np.array_split(means, 1 + RESAMPLES * len(sample) // AT_ONCE):
        some[:] = rng.choice(np.array(sample, dtype=np.float64), (len(some), len(sample))).mean(axis=1)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(means, [tail, 100.0 - tail])
    return float(low), float(high)


def cells(trials: pd.DataFrame, sweep: Sweep) -> pd.DataFrame:
    """A row for each cell of the grid, in its order: the axes' labels and the MEASURES.

    `trials` counts those that ran to an end, `succeeded` those with success; `mean`, and `low` to `high`, its
    bootstrap interval, are of the number of experiments; `iterations` is the mean of theirs; `raised` counts
    trials that ended by an error, which are in no other number; `paper` is the paper's mean, nan where it has
    none. Means too are `hardware_seconds`, `success_rate`, the share of test episodes in which the last
    policies succeed (of those in which any of the sweep's does), `reliable`, the share of trials in which
    this is at least RELIABLE, and `long_success_rate`, the share of long test episodes that last to their
    end.
    """
    names = [axis.name for axis in sweep.axes]
    trials_of: dict[tuple[str, ...], list[dict[Any, Any]]] = {cell.labels: [] for cell in sweep.cells}
    for row in trials.to_dict("records"):
        trials_of[tuple(row[name] for name in names)].append(row)
    paper, possible = sweep.report.paper, attainable(trials)
    rows = [[*labels, *_measures(own, possible), paper.get(labels, nan)] for labels, own in trials_of.items()]
    return pd.DataFrame(rows, columns=[*names, *MEASURES])


def attainable(trials: pd.DataFrame) -> list[bool]:
    """Test episodes, the same for all trials, in which any last policy succeeds; all, if none does.

    So episodes in which nobody could succeed count against no policy. What one policy of a sweep does is
    possible; the reverse is a guess, which more trials make better.
    """
    tested = [text for text in trials["test_episodes"] if text]
    possible = [any(each == "1" for each in episodes) for episodes in zip_longest(*tested)]
    return possible if any(possible) else [True] * len(possible)


def _measures(trials: Sequence[Mapping[str, Any]], possible: Sequence[bool]) -> list[float]:
    """The measures of a cell but the last."""
    outcomes = [trial["outcome"] for trial in trials]
    ended = [trial for trial in trials if trial["outcome"] != "error"]
    experiments, iterations = (
        [float(trial[name]) for trial in ended] for name in ("experiments", "iterations")
    )
    counts = (len(ended), outcomes.count("succeeded"), outcomes.count("error"))
    seconds, long = (
        [float(trial[name]) for trial in ended] for name in ("hardware_seconds", "long_success_rate")
    )
    rates = [success_rate(trial["test_episodes"], possible) for trial in ended if trial["test_episodes"]]
    reliable = [float(rate >= RELIABLE) for rate in rates]
    tests = (_mean(seconds), _mean(rates), _mean(reliable), _mean(long))
    return [*counts, _mean(experiments), *interval(experiments), _mean(iterations), *tests]


def success_rate(episodes: str, possible: Sequence[bool]) -> float:
    """The share of test episodes in which a policy succeeds, "101" of three, among the possible ones."""
    return _mean([float(each == "1") for each, counts in zip(episodes, possible, strict=False) if counts])


def _mean(values: Sequence[float]) -> float:
    """The mean of those that are known; nan if none is."""
    known = [value for value in values if not isnan(value)]
    return float(np.mean(known)) if known else nan


def layout(table: pd.DataFrame, sweep: Sweep) -> Layout:
    """The cells as text."""
    rows = dict(zip((cell.labels for cell in sweep.cells), table.to_dict("records"), strict=True))
    measures = sweep.report.measures
    return arrange(sweep, measures, lambda labels: [TEXTS[name](rows[labels]) for name in measures])


def arrange(
    sweep: Sweep, measures: Sequence[str], texts: Callable[[tuple[str, ...]], Sequence[str]]
) -> Layout:
    """Texts of every cell, by its labels: the report's column axis side by side, the other axes downwards."""
    aside = next((axis for axis in sweep.axes if axis.name == sweep.report.columns), None)
    down = [axis for axis in sweep.axes if axis is not aside]
    head = [name for axis in down for name in _heads(axis)]
    for label in aside.labels if aside else ("",):
        head += [f"{_column_head(aside, label)}: {measure}" if aside else measure for measure in measures]
    body = []
    for point in itertools.product(*(range(len(axis.labels)) for axis in down)):
        line = [text for axis, index in zip(down, point, strict=True) for text in axis.texts[index]]
        labels = {axis.name: axis.labels[index] for axis, index in zip(down, point, strict=True)}
        for label in aside.labels if aside else ("",):
            where = labels | ({aside.name: label} if aside else {})
            line += texts(tuple(where[axis.name] for axis in sweep.axes))
        body.append(line)
    return Layout(head, body)


def _heads(axis: Axis) -> list[str]:
    """Heads of an axis' columns: its name, or its keys without their groups, in words."""
    names = axis.keys if len(axis.texts[0]) > 1 else [axis.name]
    return [name.split(".")[-1].replace("_", " ") for name in names]


def _column_head(axis: Axis, label: str) -> str:
    """A label at the head of columns; a number says of what."""
    return f"{'/'.join(_heads(axis))} {label}" if axis.numeric else label


def _number(value: float) -> str:
    """A mean with one decimal."""
    return BLANK if np.isnan(value) else f"{value:.1f}"


def _share(value: float) -> str:
    """A share in percent."""
    return BLANK if np.isnan(value) else f"{value:.0%}"


def _experiments(row: Mapping[Any, Any]) -> str:
    """Mean and interval."""
    text = _number(row["mean"])
    return text if np.isnan(row["low"]) else f"{text} [{row['low']:.1f}, {row['high']:.1f}]"


def _succeeded(row: Mapping[Any, Any]) -> str:
    """Success rate as a fraction, and what is in no number."""
    text = f"{row['succeeded']}/{row['trials']}"
    return f"{text}, {row['raised']} raised" if row["raised"] else text


# Of a cell, by what `sweep.report.measures` names.
TEXTS: Mapping[str, Callable[[Mapping[Any, Any]], str]] = {
    "experiments": _experiments,
    "iterations": lambda row: _number(row["iterations"]),
    "succeeded": _succeeded,
    "hardware_seconds": lambda row: _number(row["hardware_seconds"]),
    "success_rate": lambda row: _share(row["success_rate"]),
    "reliable": lambda row: _share(row["reliable"]),
    "long_success_rate": lambda row: _share(row["long_success_rate"]),
    "paper": lambda row: _number(row["paper"]),
}


def markdown(arrangement: Layout) -> str:
    """A layout as markdown."""
    lines = [arrangement.head, ["--:"] * len(arrangement.head), *arrangement.body]
    return "\n".join("| " + " | ".join(map(text, texts)) + " |" for texts in lines) + "\n"


def plain(arrangement: Layout) -> str:
    """A layout as aligned text, its heads on two lines."""
    heads = [head.rpartition(": " if ": " in head else " ") for head in arrangement.head]
    lines = [[head[0] for head in heads], [head[2] for head in heads], *arrangement.body]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(texts, widths, strict=True)).rstrip()
        for texts in lines
    )


def legend(sweep: Sweep, trials: pd.DataFrame) -> str:
    """What the numbers are."""
    iterations = "iterations: likewise; " if "iterations" in sweep.report.measures else ""
    return (
        f"experiments: mean number of hardware experiments until success [{CONFIDENCE:.0%} bootstrap "
        f"interval]; {iterations}a trial that never succeeds counts all that it may make."
        f"{_of_tests(sweep, trials)}"
    )


def _of_tests(sweep: Sweep, trials: pd.DataFrame) -> str:
    """What the numbers of test episodes are, where any is shown."""
    possible = attainable(trials)
    if not possible or not {"success_rate", "reliable", "long_success_rate"} & set(sweep.report.measures):
        return ""
    nobody = len(possible) - sum(possible)
    return (
        f" success_rate: mean share of {sum(possible)} test episodes in which a trial's last policy succeeds"
        f"{f' (in {nobody} more none does)' if nobody else ''}; reliable: share of trials where that is at "
        f"least {RELIABLE:.0%}; long_success_rate: share of long test episodes that last to their end."
    )
