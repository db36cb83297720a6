"""Observed shares, k of n, with their confidence intervals."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """Bounds of a number."""

    low: float
    high: float


def wilson(k: float, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Wilson's score interval of a share k / n (E. B. Wilson, JASA 22, 1927); nan if n is 0.

    Averaged over shares, its coverage is close to the confidence.
    """
    if not n:
        return Interval(np.nan, np.nan)
    z, share = NormalDist().inv_cdf(0.5 + confidence / 2), k / n
    centre = share + z**2 / (2 * n)
    spread = z * np.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2)
    low, high = (centre - spread) / (1 + z**2 / n), (centre + spread) / (1 + z**2 / n)
    return Interval(float(low) if k else 0.0, float(high) if k < n else 1.0)


def clopper_pearson(k: int, n: int, confidence: float = CONFIDENCE) -> Interval:
    """The exact interval of a share k / n (C. Clopper and E. Pearson, Biometrika 26, 1934); nan if n is 0.

    Its coverage is at least the confidence, for any true share.
    """
    if not n:
        return Interval(np.nan, np.nan)
    tail = (1 - confidence) / 2
    if k in (0, n):
        return Interval(tail ** (1 / n), 1.0) if k else Interval(0.0, 1 - tail ** (1 / n))
    from scipy.special import betaincinv  # lazily: workers whose policies pass do not need it

    low, high = betaincinv(k, n - k + 1, tail), betaincinv(k + 1, n - k, 1 - tail)
    return Interval(float(low), float(high))


def passes_needed(share: float, error: float) -> int:
    """The fewest passes in a row that refute a share of at most `share`, at this probability of error.

    After n passes without a failure, the exact one-sided bound is error^(1/n).
    """
    return max(1, int(np.ceil(np.log(error) / np.log(share) - 1e-9)))


def counted_share(k: int, n: int) -> str:
    """A count with the Wilson interval of its share: 18 of 20 (70% to 97%)."""
    if not n:
        return "0 of 0"
    low, high = wilson(k, n)
    return f"{k} of {n} ({low:.0%} to {high:.0%})"
