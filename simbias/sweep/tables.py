"""The table of a sweep: cells with their mean number of experiments, beside the paper's."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from simbias.core.messages import counted
from simbias.core.proportions import CONFIDENCE, wilson
from simbias.sweep.grid import Sweep
from simbias.sweep.statistics import FEWEST, episodes_needed, interval, passed, verdicts
from simbias.trial.summary import Outcome

BLANK = "–"  # noqa: RUF001  if there is no number
RELIABLE = 0.9  # success rate from which a policy counts as reliable
MEASURES = (
    *("trials", "succeeded", "raised", "mean", "low", "high", "iterations", "hardware_seconds"),
    *("success_rate", "reliable", "tested", "holding", "different_policies", "long_success_rate", "paper"),
)


class Layout(NamedTuple):
    """A table as text."""

    head: list[str]
    body: list[list[str]]


def cells(trials: pd.DataFrame, sweep: Sweep) -> pd.DataFrame:
    """A row for each cell of the grid, in its order: the axes' labels and the MEASURES.

    `trials` counts those that ended without an error, `succeeded` those with success. `mean` and its interval
    from `low` to `high` (`simbias.sweep.statistics.interval`) are for the number of experiments; `iterations`
    is the mean number of iterations. `raised` counts trials that ended with an error, which are excluded
    elsewhere; `paper` is the paper's mean, or nan. Further means are `hardware_seconds`, of all experiments;
    `success_rate`, the share of test episodes in which the last policies succeed (or last for the horizon, if
    the task defines no success); `reliable`, the share of trials in which this is at least RELIABLE; and
    `long_success_rate`, the share of long test episodes that last to their end. Of the `tested` last policies
    with enough episodes, `holding` pass the report's bar (`simbias.sweep.statistics.holds`);
    `different_policies` counts equal ones once.
    """
    names = [axis.name for axis in sweep.axes]
    trials_of: dict[tuple[str, ...], list[dict[Any, Any]]] = {cell.labels: [] for cell in sweep.cells}
    for row in trials.to_dict("records"):
        trials_of[tuple(row[name] for name in names)].append(row)
    report = sweep.report
    rows = [
        [*labels, *_measures(own, report.bar), report.paper.get(labels, nan)]
        for labels, own in trials_of.items()
    ]
    return pd.DataFrame(rows, columns=[*names, *MEASURES])


def _measures(trials: Sequence[Mapping[str, Any]], bar: float) -> list[float]:
    """The measures of a cell, except the last."""
    outcomes = [trial["outcome"] for trial in trials]
    ended = [trial for trial in trials if trial["outcome"] != "error"]
    counts = (len(ended), outcomes.count("succeeded"), outcomes.count("error"))
    names = ("experiments", "iterations", "hardware_seconds", "long_success_rate")
    experiments, iterations, seconds, long = ([float(trial[name]) for trial in ended] for name in names)
    tested = [trial for trial in ended if trial["test_episodes"]]
    rates = [success_rate(trial["test_episodes"]) for trial in tested]
    reliable = [float(rate >= RELIABLE) for rate in rates]
    held = verdicts([passed(trial["test_episodes"], trial["lasting_episodes"]) for trial in tested], bar)
    judged = ~np.isnan(held)
    different = len({trial["policy"] or trial["hash"] for trial in itertools.compress(tested, judged)})
    holding = (int(judged.sum()), int(np.nansum(held)), different)
    means = (_mean(seconds), _mean(rates), _mean(reliable), *holding, _mean(long))
    return [*counts, _mean(experiments), *interval(experiments), _mean(iterations), *means]


def numbers_of_episodes(tests: Iterable[str]) -> str:
    """The range of numbers of test episodes, such as "4 to 10"; "" if no policy was tested."""
    counts = sorted({len(episodes) for episodes in tests if episodes})
    return " to ".join(map(str, dict.fromkeys(counts[:1] + counts[-1:])))


def success_rate(episodes: str) -> float:
    """The share of test episodes that count as a success; "101" means two of three."""
    return episodes.count("1") / len(episodes)


def _mean(values: Sequence[float]) -> float:
    """The mean of the known values; nan if there are none."""
    known = [value for value in values if not isnan(value)]
    return float(np.mean(known)) if known else nan


def layout(table: pd.DataFrame, sweep: Sweep) -> Layout:
    """The cells as text."""
    rows = dict(zip((cell.labels for cell in sweep.cells), table.to_dict("records"), strict=True))
    for row in rows.values():
        row["unfinished"] = sweep.repetitions - row["trials"] - row["raised"]
    measures = sweep.report.measures
    return arrange(sweep, measures, lambda labels: [TEXTS[name](rows[labels]) for name in measures])


def arrange(
    sweep: Sweep, measures: Sequence[str], texts: Callable[[tuple[str, ...]], Sequence[str]]
) -> Layout:
    """Arrange texts of all cells by label: the report's column axis in columns, the other axes in rows."""
    aside = next((axis for axis in sweep.axes if axis.name == sweep.report.columns), None)
    down = [axis for axis in sweep.axes if axis is not aside]
    head = [name for axis in down for name in axis.heads]
    for label in aside.labels if aside else ("",):
        head += [f"{aside.words(label)}: {measure}" if aside else measure for measure in measures]
    body = []
    for points in itertools.product(*(axis.points for axis in down)):
        line = [text for point in points for text in point.texts]
        labels = {axis.name: point.label for axis, point in zip(down, points, strict=True)}
        for label in aside.labels if aside else ("",):
            where = labels | ({aside.name: label} if aside else {})
            line += texts(tuple(where[axis.name] for axis in sweep.axes))
        body.append(line)
    return Layout(head, body)


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


def share(k: int, n: int, independent: int | None = None) -> str:
    """A count with the Wilson interval of its share: 8/10 [49%, 94%]; by default all n are independent."""
    if not n:
        return BLANK
    units = n if independent is None else independent
    low, high = wilson(units * k / n, units)
    return f"{k}/{n} [{low:.0%}, {high:.0%}]"


def _succeeded(row: Mapping[Any, Any]) -> str:
    """The share of trials that succeeded, and the numbers of those that raised an error or have not ended."""
    others = (f", {row[each]} {each}" for each in ("raised", "unfinished") if row.get(each))
    return share(row["succeeded"], row["trials"]) + "".join(others)


# Texts of a cell, by the names in `sweep.report.measures`.
TEXTS: Mapping[str, Callable[[Mapping[Any, Any]], str]] = {
    "experiments": _experiments,
    "iterations": lambda row: _number(row["iterations"]),
    "succeeded": _succeeded,
    "hardware_seconds": lambda row: _number(row["hardware_seconds"]),
    "success_rate": lambda row: _share(row["success_rate"]),
    "reliable": lambda row: _share(row["reliable"]),
    "holds": lambda row: share(row["holding"], row["tested"], row["different_policies"]),
    "long_success_rate": lambda row: _share(row["long_success_rate"]),
    "paper": lambda row: _number(row["paper"]),
}


def plain(arrangement: Layout) -> str:
    """A layout as aligned text, with headings on two lines."""
    heads = [head.rpartition(": " if ": " in head else " ") for head in arrangement.head]
    lines = [[head[0] for head in heads], [head[2] for head in heads], *arrangement.body]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(text.rjust(width) for text, width in zip(texts, widths, strict=True)).rstrip()
        for texts in lines
    )


def left_out(outcomes: Iterable[str]) -> str:
    """A sentence on trials that raised an error, to append to others; "" if none did."""
    return _left_out([*outcomes].count("error"), "raised an error")


def untested(tests: Iterable[str]) -> str:
    """A sentence on trials that ended without a test of their last policy; "" if none did."""
    return _left_out([*tests].count(""), "ended without a test")


def _left_out(count: int, why: str) -> str:
    """A sentence on this number of trials; "" for zero."""
    return f" {counted(count, 'trial')} {why} and {'is' if count == 1 else 'are'} left out." * bool(count)


def failures(trials: pd.DataFrame) -> str:
    """The experiments that trials without success count as, if these differ, to append; "" otherwise."""
    counted_as = trials.loc[trials["outcome"] == Outcome.NOT_SUCCEEDED, "experiments"]
    if counted_as.nunique() < 2:
        return ""
    few, many = counted_as.min(), counted_as.max()
    return f" (here {few:g} to {many:g}: where trials failed, a smaller mean need not be better)"


def legend(sweep: Sweep, trials: pd.DataFrame) -> str:
    """The meaning of the numbers, in words."""
    iterations = "iterations: likewise; " if "iterations" in sweep.report.measures else ""
    seconds = "hardware_seconds: mean duration of the experiments made, also without success; "
    seconds *= "hardware_seconds" in sweep.report.measures
    return (
        f"experiments: mean number of hardware experiments until success [{CONFIDENCE:.0%} bootstrap "
        f"interval, where at least {FEWEST} trials are not all equal]; {iterations}a trial that never "
        f"succeeds counts all that it may make{failures(trials)}; {seconds}beside counts: Wilson intervals "
        "of the share, of trials that are independent."
        f"{_of_tests(sweep, trials)}{left_out(trials['outcome'])}"
    )


def _of_tests(sweep: Sweep, trials: pd.DataFrame) -> str:
    """The meaning of the numbers of test episodes, if any are shown."""
    count = numbers_of_episodes(trials["test_episodes"])
    if not count:
        return ""
    needed = episodes_needed(sweep.report.bar)
    few = any(0 < len(episodes) < needed for episodes in trials["test_episodes"])
    takes = f" (of those with the {needed} episodes it takes)" * few
    texts = {
        "success_rate": f"mean share of {count} test episodes in which a trial's last policy {sweep.success}",
        "reliable": f"share of trials where that is at least {RELIABLE:.0%}",
        "holds": "last policies of which the share of test episodes passed, long ones to their end, has a "
        f"lower Wilson limit above {sweep.report.bar:.0%}{takes}; intervals count equal policies once",
        "long_success_rate": "mean share of long test episodes that last to their end",
    }
    shown = [f"{name}: {words}" for name, words in texts.items() if name in sweep.report.measures]
    return f" {'; '.join(shown)}." if shown else ""
