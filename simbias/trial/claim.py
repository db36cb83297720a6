"""The claim of a successful trial about its last policy, based on its own experiments alone."""

from __future__ import annotations

from math import pi
from typing import Annotated, NamedTuple

from pydantic import Field

from simbias.core.proportions import clopper_pearson, passes_needed
from simbias.core.records import Iteration

ERROR = 0.05  # probability that a trial overstates the share of starts for any of its policies

Confidence = Annotated[float, Field(gt=0, lt=1)]  # a share of starts to be established


class Claim(NamedTuple):
    """Share of starts that a policy holds, for as long as an experiment takes."""

    share: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"holds {self.share:.0%} of starts ({self.low:.0%} to {self.high:.0%})"


def error_of(policy: int) -> float:
    """The part of ERROR for a trial's policy of this number, from 0; the parts of all policies sum to ERROR.

    A trial continues until a policy passes, so passes by luck become likelier the more policies it tries.
    """
    return ERROR * 6 / (pi * (policy + 1)) ** 2


def passes_for(share: float | None, policy: int, experiments: int = 1, passes: int | None = None) -> int:
    """Passes in a row after which a trial may claim this share of starts for its policy of this number.

    It is at least the number of an iteration's experiments. If no share is required (None), it is that
    number, or `passes` if given.
    """
    if share is None:
        return passes or experiments
    return max(experiments, passes_needed(share, error_of(policy)))


def check_passes(passes: int | None, experiments: int) -> None:
    """Raise ValueError if `passes` is less than the number of an iteration's experiments."""
    if passes is not None and passes < experiments:
        raise ValueError(f"passes: {passes} are fewer than the {experiments} experiments of an iteration")


def claim_of(iteration: Iteration) -> Claim | None:
    """The claim that an iteration's experiments support for its policy, with exact one-sided bounds.

    None if a start was not drawn by the task, but chosen by the method.
    """
    if any(rollout.given_start for rollout in iteration.experiments):
        return None
    n = len(iteration.experiments)
    k = sum(rollout.failed_at is None for rollout in iteration.experiments)
    return Claim(k / n, *clopper_pearson(k, n, 1 - 2 * error_of(iteration.index)))
