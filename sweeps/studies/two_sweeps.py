"""The experiments and successes of two published sweeps of the same cells, whose trials met other seeds.

`python sweeps/studies/two_sweeps.py SWEEP OTHER` compares the other with the first. A trial that never
succeeds counts all experiments that it may make.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
import pandas as pd

from simbias.core.proportions import counted_share
from simbias.core.records import Array
from simbias.sweep import results
from simbias.sweep.grid import expand
from simbias.sweep.statistics import holm, mean_text, sign_test

MARGINS = (1.0, 2.0)  # experiments


def compared(names: tuple[str, str]) -> str:
    """Counts, the mean difference with its interval, and tests over cells and of each, in text."""
    from scipy.stats import fisher_exact, mannwhitneyu

    sweeps = [expand([f"+sweep={name}"]) for name in names]
    trials = [results.published(sweep) for sweep in sweeps]
    first, other = (by_cell(own, [axis.name for axis in sweeps[0].axes]) for own in trials)
    succeeded = [int((own["outcome"] == "succeeded").sum()) for own in trials]
    failed = [len(own) - count for own, count in zip(trials, succeeded, strict=True)]
    differences = other.mean(axis=0) - first.mean(axis=0)
    cells = zip(first.T, other.T, strict=True)
    tests = holm({str(i): float(mannwhitneyu(a, b).pvalue) for i, (a, b) in enumerate(cells)})
    within = [f"{margin:g}" for margin in MARGINS if equivalent(differences, margin)]
    above, below = (differences > 0).sum(), (differences < 0).sum()
    lines = [
        f"{name}: {counted_share(count, len(own))} succeeded, {own['experiments'].mean():.2f} experiments"
        for name, count, own in zip(names, succeeded, trials, strict=True)
    ]
    lines += [
        f"difference: {mean_text(differences, '.2f')} experiments",
        f"cells with more, with fewer: {above}, {below}; sign test, p = {sign_test(differences):.2f}",
        f"equivalent over cells within experiments of: {', '.join(within) or 'none'}",
        f"success, Fisher's exact test: p = {fisher_exact([succeeded, failed])[1]:.2f}",
        f"each cell's experiments, Mann-Whitney, Holm over {len(tests)}: p >= {min(tests.values()):.2f}",
    ]
    return "\n".join(lines)


def by_cell(trials: pd.DataFrame, axes: list[str]) -> Array:
    """Experiments (r, c) of repetitions and cells, in the sweep's order."""
    cells = [own.sort_values("repetition")["experiments"] for _, own in trials.groupby(axes, sort=False)]
    return np.array(cells).T


def equivalent(differences: Sequence[float], margin: float) -> bool:
    """Whether the mean of paired differences is within +-margin, by two one-sided t-tests at 5% each.

    Only this lets one say "no difference" (D. Schuirmann, J. Pharmacokin. Biopharm. 15, 1987).
    """
    from scipy.stats import ttest_1samp

    if len(differences) < 2:
        return False
    if np.ptp(differences) == 0:
        return bool(abs(differences[0]) < margin)
    above = ttest_1samp(differences, -margin, alternative="greater").pvalue
    below = ttest_1samp(differences, margin, alternative="less").pvalue
    return bool(max(above, below) < 0.05)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweep")
    parser.add_argument("other")
    arguments = parser.parse_args()
    print(compared((arguments.sweep, arguments.other)))
