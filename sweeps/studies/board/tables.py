"""What the predictions are worth, as `board.yaml` says."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.stats import rankdata

from simbias.core.proportions import wilson
from simbias.core.records import Array

SAMPLES, SEED = 10_000, 0  # of the bootstrap
BINS = (0.0, 0.2, 0.8, 1.0)
INTERVAL = (0.05, 0.95)  # quantiles of draws


def of_runs(draws: pd.DataFrame) -> pd.DataFrame:
    """A row for each way and run: what is predicted of it, and what came."""
    recorded = draws[draws["way"] == "recorded"].set_index(["set", "run"])[["success", "up", "score"]]
    grouped = draws[draws["way"] != "recorded"].groupby(["way", "set", "run"], sort=False)
    predicted = pd.DataFrame(
        {
            "p": (grouped["success"].sum() + 0.5) / (grouped.size() + 1),
            "up": grouped["up"].median(),
            "least": grouped["up"].quantile(INTERVAL[0]),
            "most": grouped["up"].quantile(INTERVAL[1]),
            "score": grouped["score"].mean(),
        }
    )
    return predicted.reset_index().join(recorded.add_suffix("_recorded"), on=["set", "run"])


def summary(runs: pd.DataFrame) -> str:
    """Tables of all runs as markdown."""
    own = {str(way): part for way, part in runs.groupby("way", sort=False)}
    return _scores(own) + _calibration(own) + _sets(own)


def _scores(own: dict[str, pd.DataFrame]) -> str:
    """The main table, a row for each way."""
    text = (
        "| way | Brier score | over base rate | over sets' rates | error of time up, s | within 90% "
        "| rank of sets | acrobot | pendubot |\n" + "| --- " * 9 + "|\n"
    )
    for way, runs in own.items():
        y, brier = runs["success_recorded"], np.mean((runs["p"] - runs["success_recorded"]) ** 2)
        base, of_sets = (
            y.var(ddof=0),
            np.mean((y - runs.groupby("set")["success_recorded"].transform("mean")) ** 2),
        )
        held = (runs["up_recorded"] >= runs["least"]) & (runs["up_recorded"] <= runs["most"])
        ranks = [_rank(runs[runs["set"].str.startswith(robot)]) for robot in ("", "acrobot", "pendubot")]
        text += f"| {way} | {brier:.3f} | {brier / base:.2f} | {brier / of_sets:.2f} "
        text += f"| {np.mean(np.abs(runs['up'] - runs['up_recorded'])):.2f} | {100 * held.mean():.0f}% | "
        text += " | ".join(ranks) + " |\n"
    return text + "\n"


def _rank(runs: pd.DataFrame) -> str:
    """Spearman's correlation of sets' mean scores, and its bootstrap interval."""
    rng = np.random.default_rng(SEED)
    pairs = [part[["score", "score_recorded"]].to_numpy() for _, part in runs.groupby("set", sort=False)]
    means = np.array([pair.mean(axis=0) for pair in pairs])
    resampled = np.array(
        [pair[rng.integers(len(pair), size=(SAMPLES, len(pair)))].mean(axis=1) for pair in pairs]
    )
    chosen = rng.integers(len(pairs), size=(SAMPLES, len(pairs)))
    made = _spearman(resampled[chosen, np.arange(SAMPLES)[:, None]])
    low, high = np.nanquantile(made, [0.025, 0.975])
    return f"{_spearman(means[None])[0]:.2f} ({low:.2f} to {high:.2f})"


def _spearman(means: Array) -> Array:
    """That (k,) of two columns (k, sets, 2) each; nan where one is constant."""
    ranks = rankdata(means, axis=1)
    ranks = ranks - ranks.mean(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        products = np.sum(ranks[..., 0] * ranks[..., 1], axis=1)
        correlations: Array = products / np.sqrt(np.prod(np.sum(ranks**2, axis=1), axis=1))
    return correlations


def _calibration(own: dict[str, pd.DataFrame]) -> str:
    """Shares of runs that succeed, by the probability that was predicted."""
    text = "| way | " + " | ".join(f"{100 * a:.0f} to {100 * b:.0f}%" for a, b in pairwise(BINS))
    text += " |\n" + "| --- " * len(BINS) + "|\n"
    for way, runs in own.items():
        cells = []
        for low, high in pairwise(BINS):
            chosen = runs[(runs["p"] > low) & (runs["p"] <= high)]["success_recorded"]
            least, most = wilson(int(chosen.sum()), len(chosen)) if len(chosen) else (0.0, 1.0)
            cells.append(f"{chosen.sum():.0f} of {len(chosen)} ({100 * least:.0f} to {100 * most:.0f}%)")
        text += f"| {way} | " + " | ".join(cells) + " |\n"
    return text + "\n"


def _sets(own: dict[str, pd.DataFrame]) -> str:
    """Success, time up and score of each set, recorded and predicted."""
    first = next(iter(own.values()))
    text = ""
    columns: list[tuple[str, str, Callable[[Array], str]]] = [
        ("success", "p", lambda values: f"{100 * values.mean():.0f}%"),
        ("up", "up", lambda values: f"{values.mean():.1f}"),
        ("score", "score", lambda values: f"{values.mean():.3f}"),
    ]
    for recorded, predicted, form in columns:
        text += f"| {recorded} | recorded | " + " | ".join(own) + " |\n" + "| --- " * (2 + len(own)) + "|\n"
        for name, runs in first.groupby("set", sort=False):
            parts = [form(each[each["set"] == name][predicted].to_numpy()) for each in own.values()]
            text += (
                f"| {name} | {form(runs[f'{recorded}_recorded'].to_numpy())} | " + " | ".join(parts) + " |\n"
            )
        text += "\n"
    return text
