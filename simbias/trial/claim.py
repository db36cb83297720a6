"""The claim of a successful trial about its last policy, by its experiments alone."""

from __future__ import annotations

from math import pi
from typing import Annotated, NamedTuple

from pydantic import Field

from simbias.core.proportions import clopper_pearson, passes_needed
from simbias.core.records import Iteration

ERROR = 0.05  # probability with which any policy of a trial is said to hold more starts than it does

Confidence = Annotated[float, Field(gt=0, lt=1)]  # a share of starts that is to be known


class Claim(NamedTuple):
    """Share of starts that a policy holds, for as long as an experiment takes."""

    share: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"holds {self.share:.0%} of starts ({self.low:.0%} to {self.high:.0%})"


def error_of(policy: int) -> float:
    """The part of ERROR for the trial's policy of this number, from 0: all together they make ERROR.

    A trial goes on until a policy passes, so the more policies it tries, the more passes are luck.
    """
    return ERROR * 6 / (pi * (policy + 1)) ** 2


def passes_for(share: float | None, policy: int, experiments: int = 1, passes: int | None = None) -> int:
    """Passes in a row after which a trial may claim this share of starts for its policy of this number.

    At least an iteration's experiments. A trial that does not ask (None) needs these, or as many passes as
    are given.
    """
    if share is None:
        return passes or experiments
    return max(experiments, passes_needed(share, error_of(policy)))


def check_passes(passes: int | None, experiments: int) -> None:
    """Refuse fewer passes than an iteration's experiments, which a ValueError says."""
    if passes is not None and passes < experiments:
        raise ValueError(f"passes: {passes} are fewer than the {experiments} experiments of an iteration")


def claim_of(iteration: Iteration) -> Claim:
    """The evidence of an iteration's experiments for its policy, with exact one-sided bounds."""
    n = len(iteration.experiments)
    k = sum(rollout.failed_at is None for rollout in iteration.experiments)
    return Claim(k / n, *clopper_pearson(k, n, 1 - 2 * error_of(iteration.index)))
