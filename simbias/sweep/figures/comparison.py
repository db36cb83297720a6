"""Methods against each other, over all cells of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from simbias.core.proportions import wilson
from simbias.core.records import Array
from simbias.pictures.elements.layout import legend
from simbias.pictures.elements.style import SIMULATION, plain, series_style
from simbias.sweep.batches import Outcomes
from simbias.sweep.figure import FigureError, SweepFigure, SweptTrials
from simbias.sweep.picture import Picture
from simbias.sweep.statistics import (
    holds,
    holm,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    sign_test,
    stratified_bootstrap,
    success_curve,
)

WIDTH, ROW, REST = 11.0, 0.24, 2.4  # in: of the figure, of a method, of all else
THRESHOLDS = np.linspace(0, 1, 101)


class Comparison(SweepFigure):
    """Each point of an axis against all, over the cells of the other axes, by what its last policies hold.

    A trial's score is the share of its test episodes that last to their end; one that raised has zero. It
    counts as a success where its last policy holds (`simbias.sweep.statistics.holds`). Left: interquartile
    mean of the scores, with a stratified bootstrap over cells. Middle: performance profiles. Right: success
    against experiments, by Kaplan and Meier's estimate.

    Parameters
    ----------
    axis
        Whose points are compared.
    references
        Points that all others are held against: by the probability of improvement, and by exact sign tests of
        pairs of one cell and repetition, corrected by Holm over all tests against one reference.
    """

    reads_trials = False

    def __init__(self, axis: str, references: list[str] = []) -> None:  # noqa: B006 (read only)
        self._axis, self._references = axis, references

    def draw(self, trials: SweptTrials, outcomes: Sequence[Outcomes]) -> Picture:
        """The picture; its numbers are a row for each method.

        Raises
        ------
        FigureError
            If no policy was tested, or there is no such axis or point.
        """
        labels = {axis.name: axis.labels for axis in trials.sweep.axes}
        if self._axis not in labels or set(self._references) - set(labels[self._axis]):
            raise FigureError(f"no such axis or point: {self._axis}, {', '.join(self._references)}")
        table = _scored(trials.table, trials.sweep.report.bar)
        if not table["score"].any() and not table["episodes"].any():
            raise FigureError("no last policy was tested: policy_test.episodes=16 does that")
        others = [name for name in labels if name != self._axis]
        own = {str(name): _Method(each, others) for name, each in table.groupby(self._axis, sort=False)}
        numbers = pd.DataFrame([method.row(name) for name, method in own.items()])
        for reference in (own[name] for name in self._references if name in own):
            name = next(name for name, method in own.items() if method is reference)
            numbers = numbers.join(_against(own, reference).add_suffix(f" {name}"), on="method")
        return Picture(_figure(own, numbers), numbers, _caption(numbers, trials.sweep.report.bar))


def _scored(table: pd.DataFrame, bar: float) -> pd.DataFrame:
    """The trials, with what their last policies hold."""
    tests = table["lasting_episodes"].where(table["lasting_episodes"] != "", table["test_episodes"])
    return table.assign(
        episodes=tests.str.len(),
        score=[text.count("1") / len(text) if text else 0.0 for text in tests],
        holds=[holds(text, bar) for text in tests],
        experiments=table["experiments"].fillna(0.0),
    )


class _Method:
    """The trials of a method: scores (r, c) of as many repetitions as all of its cells have."""

    def __init__(self, trials: pd.DataFrame, others: Sequence[str]) -> None:
        self.trials = trials.set_index([*others, "repetition"])
        cells = [own["score"].to_numpy() for _, own in trials.groupby(list(others), sort=False)]
        repetitions = min(map(len, cells))
        self.scores: Array = np.array([cell[:repetitions] for cell in cells]).T
        self.curve = success_curve(
            trials["experiments"].to_numpy(dtype=float), trials["holds"].to_numpy(dtype=bool)
        )

    def row(self, name: str) -> dict[str, Any]:
        """The method in numbers."""
        held, count = int(self.trials["holds"].sum()), len(self.trials)
        low, high = stratified_bootstrap(interquartile_mean, self.scores)
        least, most = wilson(held, count)
        return {
            "method": name,
            "trials": count,
            "raised": int((self.trials["outcome"] == "error").sum()),
            "holds": held,
            "holds_low": least,
            "holds_high": most,
            "share": interquartile_mean(self.scores),
            "share_low": low,
            "share_high": high,
            "mean_share": float(self.scores.mean()),
            "experiments": float(self.trials["experiments"].mean()),
        }


def _against(methods: dict[str, _Method], reference: _Method) -> pd.DataFrame:
    """Probability of improvement over a reference, its interval, and Holm's p of the pairs' sign tests."""
    rows, p = {}, {}
    for name, method in methods.items():
        if method is reference or method.scores.shape[1] != reference.scores.shape[1]:
            continue
        both = method.scores, reference.scores
        low, high = stratified_bootstrap(probability_of_improvement, *both)
        rows[name] = {"better": probability_of_improvement(*both), "better_low": low, "better_high": high}
        pairs = method.trials["holds"].astype(float) - reference.trials["holds"].astype(float)
        p[name] = sign_test(pairs.dropna().tolist())
    table = pd.DataFrame.from_dict(rows, orient="index")
    return table.assign(p=pd.Series(holm(p)))


def _caption(numbers: pd.DataFrame, bar: float) -> str:
    """The caption, from the numbers."""
    best = numbers.iloc[int(numbers["holds"].to_numpy().argmax())]
    return (
        f"Left: interquartile mean over cells of the share of test episodes that last to their end, with 95% "
        f"stratified bootstrap intervals. Middle: share of trials with more than so much. Right: share of "
        f"trials whose last policy holds (lower Wilson limit above {bar:.0%}) within so many experiments, "
        f"trials that never succeed censored. Of {best['trials']} trials each, most hold by "
        f"{best['method']}: {best['holds']} ({best['holds_low']:.0%} to {best['holds_high']:.0%})."
    )


def _figure(methods: dict[str, _Method], numbers: pd.DataFrame) -> Figure:
    """The figure of three panels."""
    figure = Figure(figsize=(WIDTH, ROW * len(methods) + REST), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    y = np.arange(len(numbers))
    spread = np.abs(numbers[["share_low", "share_high"]].to_numpy().T - numbers["share"].to_numpy())
    left.errorbar(numbers["share"], y, xerr=spread, fmt="o", color=SIMULATION, capsize=2, markersize=4)
    left.set_yticks(y, numbers["method"])
    left.invert_yaxis()
    left.set_xlabel("test episodes that last (interquartile mean)")
    handles = {}
    for index, (name, method) in enumerate(methods.items()):
        color, _ = series_style(index)
        dashes = ("-", "--", ":")[index // 8 % 3]
        profile = performance_profile(method.scores, THRESHOLDS)
        (handles[name],) = middle.plot(THRESHOLDS, profile, dashes, color=color, linewidth=1.2)
        curve = method.curve
        x, probability = np.append(0, curve.experiments), np.append(0, curve.probability)
        right.step(x, probability, dashes, where="post", color=color, linewidth=1.2)
    middle.set_xlabel("test episodes that last")
    middle.set_ylabel("trials with more")
    right.set_xlabel("hardware experiments")
    right.set_ylabel("trials whose last policy holds")
    for axes in (left, middle):
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_xlim(-0.03, 1.03)
    for axes in (middle, right):
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_ylim(-0.03, 1.03)
    for axes in (left, middle, right):
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        plain(axes)
    legend(figure, handles)
    return figure
