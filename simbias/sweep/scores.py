"""Scores of methods over the cells of a sweep, and what they are worth against a reference.

A trial's score is the share of test episodes that its last policy passes; see
`simbias.sweep.figures.comparison`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from simbias.core.proportions import wilson
from simbias.core.records import Array
from simbias.sweep.statistics import (
    bootstrap,
    holm,
    interquartile_mean,
    passed,
    probability_of_improvement,
    sign_test,
    verdicts,
)

SCORE, HOLDS = " score", " holds"  # columns beside those of the table and its axes


def scored(table: pd.DataFrame, bar: float) -> pd.DataFrame:
    """The trials with their scores and whether their last policies hold; nan for those that do not count."""
    tests = [*map(passed, table["test_episodes"], table["lasting_episodes"])]
    scores = np.array([text.count("1") / len(text) if text else np.nan for text in tests])
    score = np.where(table["outcome"] == "error", np.nan, scores)
    policy = table["policy"].where(table["policy"] != "", table["hash"])  # may be unpublished
    scored = table.assign(policy=policy)
    scored[SCORE], scored[HOLDS] = score, verdicts(tests, bar)
    return scored


class Method:
    """The trials of a method, with scores and the share that holds, by cell (labels of the other axes)."""

    def __init__(self, trials: pd.DataFrame, others: list[str]) -> None:
        self.trials = trials[trials[SCORE].notna()].set_index([*others, "repetition"])
        self.raised = int((trials["outcome"] == "error").sum())
        grouped: Any = trials.groupby(others, sort=False) if others else [((), trials)]
        cells = {name: own.set_index("repetition") for name, own in grouped}
        self.scores = {name: own[SCORE] for name, own in cells.items()}
        self.holding = {name: float(own[HOLDS].mean()) for name, own in cells.items()}
        self.tried = [name for name, scores in self.scores.items() if scores.notna().any()]

    def matrix(self, cells: Sequence[Any]) -> Array:
        """Scores (r, c) in these cells; nan for missing trials."""
        return pd.DataFrame([self.scores[cell] for cell in cells]).to_numpy().T

    def row(self, name: str) -> dict[str, Any]:
        """The method's numbers."""
        held, judged = int(self.trials[HOLDS].sum()), int(self.trials[HOLDS].count())
        scores, units = self.matrix(self.tried), int(np.isfinite([*self.holding.values()]).sum())
        if units == 1:
            units = self.trials.loc[self.trials[HOLDS].notna(), "policy"].nunique()
        if len(self.tried) == 1:  # then policies are resampled, each with all its trials
            alike = self.trials.groupby("policy", sort=False)[SCORE]
            resampled = pd.concat([own.reset_index(drop=True) for _, own in alike], axis=1).to_numpy()
        else:
            resampled = scores
        low, high = bootstrap(interquartile_mean, resampled)
        least, most = wilson(units * held / max(judged, 1), units)
        return {
            "method": name,
            "trials": len(self.trials),
            "raised": self.raised,
            "judged": judged,
            "holds": held,
            "holds_low": least,
            "holds_high": most,
            "share": interquartile_mean(scores),
            "share_low": low,
            "share_high": high,
            "mean_share": float(np.nanmean(scores)),
            "experiments": float(self.trials["experiments"].mean()),
        }


def against(methods: dict[str, Method], reference: Method) -> pd.DataFrame:
    """Probability of improvement over a reference, its interval, and Holm's p of sign tests."""
    rows, p = {}, {}
    for name, method in methods.items():
        cells = [cell for cell in method.tried if cell in reference.tried]
        if method is reference or not cells:
            continue
        both = method.matrix(cells), reference.matrix(cells)
        low, high = bootstrap(probability_of_improvement, *both)
        rows[name] = {"better": probability_of_improvement(*both), "better_low": low, "better_high": high}
        differences = [method.holding[cell] - reference.holding[cell] for cell in cells]
        if len(cells) == 1:
            differences = _of_pairs(method, reference)
        if np.isfinite(differences).sum() > 1:
            p[name] = sign_test(differences)
    table = pd.DataFrame.from_dict(rows, orient="index")
    return table.assign(p=pd.Series(holm(p), dtype=float))


def _of_pairs(method: Method, reference: Method) -> list[float]:
    """Differences in whether trials hold, over a cell's pairs; pairs with the same policies count once."""
    both = method.trials.join(reference.trials.add_suffix(" of reference"), how="inner")
    different = both[~both.duplicated(["policy", "policy of reference"])]
    return (different[HOLDS] - different[f"{HOLDS} of reference"]).tolist()
