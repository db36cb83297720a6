"""Statistics of sweeps: scores over cells, and differences between pairs.

A score matrix (r, c) has a row for each repetition and a column for each cell, nan where a trial raised an
error; each cell has at least one score. Intervals are at 95%.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from scipy.special import ndtr, stdtrit

from simbias.core.proportions import CONFIDENCE, Interval, wilson
from simbias.core.records import Array

BAR = 0.8  # share of starts that a policy must hold with confidence
TAIL = 0.5 * (1.0 - CONFIDENCE)
FEWEST = 5  # values, or cells, needed for an interval
RESAMPLES = 10_000
AT_ONCE = 1_000_000  # numbers drawn at a time, which bounds memory


def holds(episodes: str, bar: float = BAR) -> bool:
    """Whether the lower Wilson bound from a policy's test episodes, such as "101", exceeds the bar."""
    return bool(episodes) and wilson(episodes.count("1"), len(episodes)).low > bar


def episodes_needed(bar: float = BAR) -> int:
    """The fewest test episodes with which a policy that passes all of them holds."""
    return int(NormalDist().inv_cdf(0.5 + CONFIDENCE / 2) ** 2 * bar / (1.0 - bar)) + 1


def verdicts(tests: Sequence[str], bar: float = BAR) -> Array:
    """1 (k,) for each policy that holds, 0 for each other; nan with too few test episodes."""
    needed = episodes_needed(bar)
    return np.array([float(holds(test, bar)) if len(test) >= needed else np.nan for test in tests])


def passed(test_episodes: str, lasting_episodes: str) -> str:
    """1 for each test episode that succeeds and lasts to its own end, 0 for each other.

    Some published results do not record which episodes last.
    """
    return "".join(map(min, test_episodes, lasting_episodes)) if lasting_episodes else test_episodes


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Bootstrap interval of the mean, independent of the values' order.

    It is nan for fewer than FEWEST values, and if all are equal, as its width would be meaningless.
    """
    if len(values) < FEWEST or min(values) == max(values):
        return np.nan, np.nan
    return _interval(tuple(sorted(values)))


@lru_cache(maxsize=1000)
def _interval(sample: tuple[float, ...]) -> tuple[float, float]:
    """The interval of sorted values, cached because notes, tables and figures of a sweep share them."""
    rng, means = np.random.default_rng(0), np.empty(RESAMPLES)
    for some in np.array_split(means, 1 + RESAMPLES * len(sample) // AT_ONCE):
        some[:] = rng.choice(np.array(sample, dtype=np.float64), (len(some), len(sample))).mean(axis=1)
    low, high = np.quantile(means, tails(len(sample)))
    return float(low), float(high)


def tails(count: int) -> tuple[float, float]:
    """Tail percentiles for the bootstrap interval of a mean of `count` values.

    Percentiles are expanded by the ratio of Student's t to the normal distribution with estimated variance
    (T. Hesterberg, The American Statistician 69, 2015): at 2.5%, an interval of ten counts would contain
    their mean in 87% of samples, and of five in 78%; with expansion, in 91% and 87%.
    """
    low = float(ndtr(np.sqrt(count / (count - 1)) * stdtrit(count - 1, TAIL)))
    return low, 1.0 - low


def mean_text(values: Sequence[float], form: str) -> str:
    """Mean and interval in a number format, as "3.0 [2.1, 4.2]"; the mean alone without an interval."""
    low, high = interval(values)
    return f"{np.mean(values):{form}}" + f" [{low:{form}}, {high:{form}}]" * (not np.isnan(low))


def interquartile_mean(scores: Array) -> float:
    """The mean of the middle half of all scores (Agarwal et al., NeurIPS 2021)."""
    ordered = np.sort(scores[~np.isnan(scores)])
    outside = len(ordered) // 4
    return float(ordered[outside : len(ordered) - outside].mean())


def probability_of_improvement(scores: Array, others: Array) -> float:
    """The probability that a run of one method beats one of another in the same cell, ties counting half.

    It is the mean over cells of the Mann-Whitney statistic over all pairs (Agarwal et al., NeurIPS 2021).
    """
    difference = scores[:, None] - others[None, :]
    better = np.where(np.isnan(difference), np.nan, (difference > 0) + 0.5 * (difference == 0))
    return float(np.nanmean(better, axis=(0, 1)).mean())


def performance_profile(scores: Array, thresholds: Array) -> Array:
    """The share (k,) of scores above each threshold (k,) (E. Dolan and J. More, Math. Prog. 91, 2002)."""
    return np.mean(scores[~np.isnan(scores)][:, None] > thresholds, axis=0)


def bootstrap(statistic: Callable[..., float], *scores: Array, resamples: int = 2000) -> Interval:
    """Bootstrap interval of a statistic of score matrices (r, c) over cells.

    Cells are resampled with all their runs, the same in all matrices. The interval thus refers to new cells,
    and has a width even if the runs in each cell are identical. As in `interval`, it is nan for few or equal
    cells.
    """
    rng, count = np.random.default_rng(0), scores[0].shape[1]
    if count < FEWEST:
        return Interval(np.nan, np.nan)
    drawn = (rng.integers(count, size=count) for _ in range(resamples))
    values = [statistic(*(each[:, cells] for each in scores)) for cells in drawn]
    return Interval(*map(float, np.quantile(values, tails(count)) if np.ptp(values) else (np.nan, np.nan)))


def sign_test(differences: Sequence[float]) -> float:
    """Two-sided p-value of the sign test on pairs' differences, without ties.

    For differences of 0 and 1, it is McNemar's exact test.
    """
    from scipy.stats import binomtest

    values = np.asarray(differences)
    up, down = int(np.sum(values > 0)), int(np.sum(values < 0))
    return float(binomtest(up, up + down).pvalue) if up + down else 1.0


def holm(p: Mapping[str, float]) -> dict[str, float]:
    """Adjusted p of a family of tests (S. Holm, Scand. J. Statist. 6, 1979)."""
    adjusted, largest = {}, 0.0
    for rank, name in enumerate(sorted(p, key=lambda name: p[name])):
        largest = max(largest, min(1.0, (len(p) - rank) * p[name]))
        adjusted[name] = largest
    return {name: adjusted[name] for name in p}
