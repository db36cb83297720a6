"""Evaluations in an optimizer's search: kept in the box, counted and limited; the best point is recorded."""

# No `from __future__ import annotations`: constructors elsewhere inherit the types of SearchBudget's fields.

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np

from simbias.core.errors import ConfigError
from simbias.core.objective import as_objective
from simbias.core.ranges import EvaluationCount, Seconds, Share, Steps
from simbias.core.records import Array, Optimum

EVALUATION_LIMIT = "the evaluation limit"
STEP_LIMIT = "the limit of simulated steps"
TIME_LIMIT = "the time limit"
RELATIVE_TOLERANCE = "the relative tolerance"
TARGET = "the target cost"
ROUNDING = 1e-12  # smaller relative changes are ignored: DIRECT often evaluates points of equal cost


class SearchEnded(Exception):  # noqa: N818 (no error, as StopIteration is none)
    """Ends a search from within an optimizer's call of the objective; its text is the reason."""


@dataclass(kw_only=True, eq=False)
class SearchBudget:
    """Stopping criteria of a search, or of each stage of a two-stage search.

    Parameters
    ----------
    max_evaluations
        N_in: the most evaluations of each stage.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z| (Section V), once Z is
        below the target.
    max_steps
        Simulated steps after which the search ends, counted by the objective's `steps`.
    max_seconds
        Wall time after which the search ends; the result then depends on the machine.
    """

    max_evaluations: EvaluationCount
    relative_tolerance: Share
    max_steps: Steps | None = None
    max_seconds: Seconds | None = None


class Evaluations:
    """The evaluations of one search; the best point that was counted is kept here.

    An optimizer's own answer can be worse than the best point that it saw (a population's mean, or the best
    of the last generation). Its own limit may be inexact (NLopt's GN_ORIG_DIRECT exceeds it).

    Parameters
    ----------
    lower, upper
        The box, (p,) each.
    target_cost
        Small improvements end the search only once the best cost is below this cost.
    ends_at_target
        Whether the first cost below the target ends the search.

    Raises
    ------
    ValueError
        If the box is not finite, or is empty in some dimension.
    """

    def __init__(
        self,
        objective: Callable[[Array], float],
        lower: Array,
        upper: Array,
        budget: SearchBudget,
        target_cost: float = np.inf,
        ends_at_target: bool = False,
    ) -> None:
        self.lower = np.array(lower, dtype=np.float64)
        self.upper = np.array(upper, dtype=np.float64)
        if self.lower.ndim != 1 or not self.lower.size or self.lower.shape != self.upper.shape:
            raise ValueError(f"bounds have shapes {self.lower.shape} and {self.upper.shape}, not (p,) each")
        if not (np.isfinite([self.lower, self.upper]).all() and (self.lower < self.upper).all()):
            raise ValueError(
                f"lower {self.lower.tolist()} is not below upper {self.upper.tolist()}, or not finite"
            )
        self._objective = as_objective(objective)
        self.target_cost = target_cost
        self._limit, self._relative_tolerance = budget.max_evaluations, budget.relative_tolerance
        self._last_step = np.inf if budget.max_steps is None else self._objective.steps + budget.max_steps
        self._deadline = np.inf if budget.max_seconds is None else time.monotonic() + budget.max_seconds
        self._ends_at_target = ends_at_target
        self._best_point: Array | None = None
        self.best_cost = np.inf
        self._worst_cost = -np.inf
        self.count = 0

    @property
    def remaining(self) -> int:
        """The number of evaluations that are left."""
        return self._limit - self.count

    @property
    def below_target(self) -> bool:
        """Whether the best cost is below the target."""
        return self.best_cost < self.target_cost

    @property
    def start(self) -> Array:
        """The starting point (p,): the best one so far, or the box's centre."""
        return 0.5 * (self.lower + self.upper) if self._best_point is None else self._best_point.copy()

    @property
    def together(self) -> Callable[[Array], Array] | None:
        """Costs (k,) of points (k, p) in lockstep, neither counted nor judged; None if unsupported."""
        return self._objective.together if self._objective.lockstep else None

    def evaluate(self, point: Array) -> float:
        """Cost of the point (p,), clipped to the box in case rounding left it outside.

        Raises
        ------
        SearchEnded
            If evaluations, steps or seconds are used up, or the last improvement was within the tolerance.
        ValueError
            If the cost is not finite, or an entry of the point is nan.
        """
        self.check_budget()
        inside = self.inside(point)
        return self.judge(inside, self._objective(inside.copy()))

    def evaluate_all(self, points: Sequence[Array]) -> list[float]:
        """Costs of points (p,), as from `evaluate`; computed in lockstep if the objective supports it."""
        affordable = [self.inside(point) for point in points[: self.remaining]]
        if self.together is None or len(affordable) < 2:
            return [self.evaluate(point) for point in points]
        self.check_budget()
        costs = self.together(np.array(affordable)).tolist()
        judged = [self.judge(point, cost) for point, cost in zip(affordable, costs, strict=True)]
        if len(affordable) < len(points):
            raise SearchEnded(EVALUATION_LIMIT)
        return judged

    @property
    def ranks_afresh(self) -> bool:
        """Whether the objective draws new scenarios for each generation."""
        return self._objective.fresh

    def rank(self, points: Sequence[Array]) -> list[float]:
        """Costs by which the points (p,) of a generation are ranked.

        Points in newly drawn scenarios are counted but not judged: their costs cannot be compared across
        generations.
        """
        if not self.ranks_afresh:
            return self.evaluate_all(points)
        self.check_budget()
        if self.remaining <= len(points):  # one evaluation is reserved for the generation's mean
            raise SearchEnded(EVALUATION_LIMIT)
        self.count += len(points)
        costs = self._objective.rank(np.array([self.inside(point) for point in points])).tolist()
        for point, cost in zip(points, costs, strict=True):
            _check_finite(point, cost)
        if min(costs) < max(costs):  # not flat, whatever the means cost
            self._worst_cost = math.inf
        return costs

    def inside(self, point: Array) -> Array:
        """The point of the box nearest to the point (p,), as a new array; ValueError if an entry is nan."""
        nearest = np.minimum(np.maximum(point, self.lower), self.upper)  # faster than np.clip
        if np.isnan(nearest).any():
            raise ValueError(f"the search proposes a point with nan: {np.asarray(point).tolist()}")
        return nearest

    def check_budget(self) -> None:
        """Raise SearchEnded if something has been evaluated and the budget is used up."""
        if not self.count:
            return
        if not self.remaining:
            raise SearchEnded(EVALUATION_LIMIT)
        if self._objective.steps >= self._last_step:
            raise SearchEnded(STEP_LIMIT)
        if time.monotonic() >= self._deadline:
            raise SearchEnded(TIME_LIMIT)

    def judge(self, point: Array, cost: float) -> float:
        """Count an evaluation of a point (p,) in the box, keep the point if it is the best; return its cost.

        Raises
        ------
        SearchEnded, ValueError
            As for `evaluate`, except that steps and seconds are not checked.
        """
        if not self.remaining:
            raise SearchEnded(EVALUATION_LIMIT)
        self.count += 1
        _check_finite(point, cost)
        self._worst_cost = max(self._worst_cost, cost)
        if cost < self.best_cost:
            change = (self.best_cost - cost) / max(abs(cost), np.finfo(np.float64).tiny)
            self._best_point, self.best_cost = point, cost
            if ROUNDING < change < self._relative_tolerance and self.below_target:
                raise SearchEnded(RELATIVE_TOLERANCE)
            if self._ends_at_target and self.below_target:
                raise SearchEnded(TARGET)
        return cost

    def try_first(self, points: Sequence[Array]) -> None:
        """Evaluate as many points (p,) as the budget allows; small improvements do not end the search."""
        tolerance, self._relative_tolerance = self._relative_tolerance, 0.0
        with suppress(SearchEnded):  # if steps or seconds are spent, the search stops at its start
            self.evaluate_all(points[: self.remaining])
        self._relative_tolerance = tolerance

    def run(self, search: Callable[[Self], str]) -> str:
        """Run a search on these evaluations; return why it ended. ValueError if it gives no words."""
        if self._ends_at_target and self.below_target:
            return TARGET
        try:
            self.check_budget()
            ended = search(self)
        except SearchEnded as end:
            return str(end)
        if not isinstance(ended, str):
            raise ValueError(f"search returned {ended!r}; it has to say why it ended, such as 'converged'")
        return ended

    def explored(self, search: Callable[[Self], str], limit: int) -> Array:
        """The best point (p,) of a search from scratch that uses at most `limit` of these evaluations.

        It ends at the first cost below the target, if there is a target.
        """
        part = copy(self)
        part._best_point, part.best_cost = None, np.inf
        part._limit = min(self.count + limit, self._limit)
        part._ends_at_target = self.target_cost < np.inf
        part.run(search)
        self.count, self._worst_cost = part.count, part._worst_cost
        if part.best_cost < self.best_cost:
            self._best_point, self.best_cost = part._best_point, part.best_cost
        return part.start

    def optimum(self, stopped_by: str) -> Optimum:
        """The best point evaluated, or else the start; `stopped_by` says if no cost is below the target."""
        if self._best_point is None:  # a generation was ranked afresh, or is more than the budget allows
            with suppress(SearchEnded):
                self.judge(self.start, self._objective(self.start))
        if not self.below_target and self.target_cost < np.inf:
            stopped_by = f"{stopped_by}, with no cost below {self.target_cost:g}"
        flat = self.count > 1 and self._worst_cost == self.best_cost
        return Optimum(self.start, self.best_cost, self.count, stopped_by, flat)


def _check_finite(point: Array, cost: float) -> None:
    """Refuse a cost that is not finite, as it cannot be ranked."""
    if not math.isfinite(cost):
        raise ConfigError("cost", f"must be finite, got {cost} for the policy {point.tolist()}")
