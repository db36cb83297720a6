"""The claim of a successful trial about its last policy, based on its own experiments alone."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Annotated, NamedTuple

from pydantic import Field

from simbias.core import Model
from simbias.core.policy import same_policy
from simbias.core.proportions import clopper_pearson, passes_needed
from simbias.core.records import Array, Iteration, Rollout

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


def iterations_with(theta: Array, model: Model | None, iterations: Sequence[Iteration]) -> list[Iteration]:
    """The iterations that tried the policy theta (p,) designed on a model, but for last digits.

    With the same parameters, a policy that is redesigned on another nominal model is another policy.
    """
    same = (each for each in iterations if same_policy(theta, each.parameters))
    return [each for each in same if _same_design(each.model, model)]


def _same_design(one: Model | None, other: Model | None) -> bool:
    """Whether policies with the same parameters are the same on both models."""
    if one is None or other is None:
        return one is other
    return one.policy is other.policy or one.nominal is other.nominal


def claim_of(iterations: Sequence[Iteration]) -> Claim | None:
    """The claim that a trial's experiments support for its last policy, with exact one-sided bounds.

    It counts the experiments of all iterations with this policy, but its lower bound is at most that of the
    last iteration alone, whose number of experiments was fixed before. None if a start of that iteration was
    not drawn by the task, but chosen by the method.
    """
    last = iterations[-1]
    if any(rollout.given_start for rollout in last.experiments):
        return None
    tried = *iterations_with(last.parameters, last.model, iterations[:-1]), last
    drawn = [rollout for each in tried for rollout in each.experiments if not rollout.given_start]
    alone, claim = (_supported(each, error_of(last.index)) for each in (last.experiments, drawn))
    return claim._replace(low=min(claim.low, alone.low))


def _supported(experiments: Sequence[Rollout], error: float) -> Claim:
    """The claim that experiments with one policy support, with this probability of error of each bound."""
    n, k = len(experiments), sum(rollout.failed_at is None for rollout in experiments)
    return Claim(k / n, *clopper_pearson(k, n, 1 - 2 * error))
