"""What every optimizer does alike: evaluate inside the box, count, remember the best point, and stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy

import numpy as np

from simbias.core.records import Array, Flags, Optimum

EVALUATION_LIMIT = "the evaluation limit"
STEP_LIMIT = "the limit of simulated steps"
TIME_LIMIT = "the time limit"
RELATIVE_TOLERANCE = "the relative tolerance"
SATISFIED = "a satisfactory cost"
ROUNDING = 1e-12  # of relative changes that say nothing: DIRECT often asks for points of equal cost


class SearchEnded(Exception):  # noqa: N818 (no error, as StopIteration is none)
    """Ends a search from inside an optimizer's call of the objective; its text says why, in words."""


Search = Callable[["Evaluations"], str]  # evaluates points until it is no longer worth it; why, in words


class Evaluations:
    """The evaluations of one search; the best point ever evaluated is kept here.

    An optimizer's own answer can be worse than the best point that it saw (a population's mean, the best of
    the last generation), and its own limit a rough one (SciPy's DIRECT and NLopt's GN_ORIG_DIRECT exceed it).

    Parameters
    ----------
    objective
        Cost of a point (p,).
    lower, upper
        The box, (p,) each.
    limit
        Largest number of evaluations.
    relative_tolerance
        epsilon: the search ends when the best cost Z improves by less than epsilon |Z| (Section V).
    satisfactory
        Best cost below which that rule holds.
    max_steps
        Simulated steps after which the search ends, as the objective's `steps` counts them.
    max_seconds
        Wall time after which it ends.

    Raises
    ------
    ValueError
        If the box is not finite, or empty in a dimension.
    """

    def __init__(
        self,
        objective: Callable[[Array], float],
        lower: Array,
        upper: Array,
        limit: int,
        relative_tolerance: float,
        satisfactory: float = np.inf,
        max_steps: int | None = None,
        max_seconds: float | None = None,
    ) -> None:
        self.lower = np.array(lower, dtype=np.float64)
        self.upper = np.array(upper, dtype=np.float64)
        if self.lower.ndim != 1 or not self.lower.size or self.lower.shape != self.upper.shape:
            raise ValueError(f"bounds have shapes {self.lower.shape} and {self.upper.shape}, not (p,) each")
        if not (np.isfinite([self.lower, self.upper]).all() and (self.lower < self.upper).all()):
            raise ValueError(
                f"lower {self.lower.tolist()} is not below upper {self.upper.tolist()}, or not finite"
            )
        self._objective = objective
        self._limit = limit
        self._relative_tolerance = relative_tolerance
        self.satisfactory = satisfactory
        self._last_step = np.inf if max_steps is None else self._steps + max_steps
        self._deadline = np.inf if max_seconds is None else time.monotonic() + max_seconds
        self._until_satisfied = False
        self._replayed: list[float] = []  # costs of an earlier rehearsal, the last one first
        self._replay_end: Evaluations  # as it stood after them; only of a rehearsal
        self._best_point: Array | None = None
        self.best_cost = np.inf
        self._worst_cost = -np.inf
        self.count = 0

    @property
    def remaining(self) -> int:
        """How many more evaluations are allowed."""
        return self._limit - self.count

    @property
    def spent(self) -> str | None:
        """Why no more should be evaluated, in words; None if some may."""
        if not self.remaining:
            return EVALUATION_LIMIT
        if self._steps >= self._last_step:
            return STEP_LIMIT
        return TIME_LIMIT if time.monotonic() >= self._deadline else None

    def _go_on(self) -> None:
        """End the search if it has evaluated something and may not go on.

        Raises
        ------
        SearchEnded
            Then.
        """
        if self.count and (reason := self.spent) is not None:
            raise SearchEnded(reason)

    @property
    def _steps(self) -> int:
        """Steps that the objective has simulated, if it counts them."""
        return getattr(self._objective, "steps", 0)

    @property
    def satisfied(self) -> bool:
        """Whether the best cost is satisfactory."""
        return self.best_cost < self.satisfactory

    @property
    def start(self) -> Array:
        """Where to start (p,): at the best point so far, or at the box's centre."""
        return 0.5 * (self.lower + self.upper) if self._best_point is None else self._best_point.copy()

    @property
    def together(self) -> Callable[[Array], Array] | None:
        """What costs points (k, p) together, if the objective offers it; neither counted nor judged."""
        return getattr(self._objective, "together", None)

    @property
    def speculate(self) -> Callable[[Array], tuple[Array, Flags]] | None:
        """What costs some of points (k, p), and says which, if the objective offers it.

        Which ones depends on the threads. So where simulated steps are limited, all are costed together.
        """
        return getattr(self._objective, "speculate", None) if self._last_step == np.inf else None

    def evaluate(self, point: Array) -> float:
        """Cost of the point (p,), moved into the box where rounding left it outside.

        Raises
        ------
        SearchEnded
            If evaluations, steps or seconds are used up, or the last improvement was within the tolerance.
        ValueError
            If the cost is not finite.
        """
        if self._replayed:
            return self._replay()
        self._go_on()
        inside = self._inside(point)
        return self._judged(inside, float(self._objective(inside.copy())))

    def evaluate_all(self, points: Sequence[Array]) -> list[float]:
        """Costs of points (p,), as `evaluate` gives them in turn; together, if the objective offers that."""
        affordable = [self._inside(point) for point in points[: self.remaining]]
        if self.together is None or len(affordable) < 2:
            return [self.evaluate(point) for point in points]
        self._go_on()
        costs = self.together(np.array(affordable)).tolist()
        judged = [self._judged(point, cost) for point, cost in zip(affordable, costs, strict=True)]
        if len(affordable) < len(points):
            raise SearchEnded(EVALUATION_LIMIT)
        return judged

    def _inside(self, point: Array) -> Array:
        """The point (p,) or the nearest one in the box, as an array of its own; quicker than np.clip."""
        return np.minimum(np.maximum(point, self.lower), self.upper)

    def _judged(self, point: Array, cost: float) -> float:
        """Count an evaluation and keep its point if it is the best."""
        self.count += 1
        if not math.isfinite(cost):
            raise ValueError(f"the cost is {cost} at the point {point.tolist()}")
        self._worst_cost = max(self._worst_cost, cost)
        if cost < self.best_cost:
            change = (self.best_cost - cost) / max(abs(cost), np.finfo(np.float64).tiny)
            self._best_point, self.best_cost = point, cost
            if ROUNDING < change < self._relative_tolerance and self.satisfied:
                raise SearchEnded(RELATIVE_TOLERANCE)
            if self._until_satisfied and self.satisfied:
                raise SearchEnded(SATISFIED)
        return cost

    def try_first(self, points: Sequence[Array]) -> None:
        """Evaluate as many of the points (p,) as are allowed; no improvement among them is convergence."""
        branch = copy(self)
        branch._relative_tolerance = 0.0
        with suppress(SearchEnded):  # steps or seconds are spent, which a search is told when it begins
            branch.evaluate_all(points[: self.remaining])
        self.adopt(branch)

    def run(self, search: Search) -> str:
        """Run a search on these; why it ended, in words."""
        try:
            self._go_on()
            return search(self)
        except SearchEnded as end:
            return str(end)

    def rehearsal(
        self, objective: Callable[[Array], float], replayed: Sequence[float], replay_end: Evaluations
    ) -> Evaluations:
        """These evaluations as they stand, of costs that are known; they go on apart, until adopted.

        The first of them are those of an earlier rehearsal: they have these costs, and end as it stood then.
        """
        branch = copy(self)
        branch._objective = objective
        branch._last_step = branch._deadline = np.inf
        branch._replayed, branch._replay_end = list(reversed(replayed)), replay_end
        return branch

    def _replay(self) -> float:
        """The next cost of an earlier rehearsal; after the last one, these stand where it stood."""
        cost = self._replayed.pop()
        if not self._replayed:
            self.adopt(self._replay_end)
        return cost

    def exploration(self, limit: int) -> Evaluations:
        """So many of these evaluations, to begin again with; they go on apart, until adopted.

        They end at the first satisfactory cost, if not every cost is.
        """
        branch = copy(self)
        branch._best_point, branch.best_cost = None, np.inf
        branch._limit = min(self.count + limit, self._limit)
        branch._until_satisfied = self.satisfactory < np.inf
        return branch

    def adopt(self, branch: Evaluations) -> None:
        """Come as far as a branch of these has come."""
        self.count = branch.count
        self._worst_cost = max(self._worst_cost, branch._worst_cost)
        if branch.best_cost < self.best_cost:
            self._best_point, self.best_cost = branch._best_point, branch.best_cost

    def optimum(self, stopped_by: str) -> Optimum:
        """The best point evaluated, at least one has been; a search that failed is said to have failed."""
        assert self._best_point is not None
        if not self.satisfied and self.satisfactory < np.inf:
            stopped_by = f"{stopped_by}, with no cost below {self.satisfactory:g}"
        flat = self.count > 1 and self._worst_cost == self.best_cost
        return Optimum(self._best_point, self.best_cost, self.count, stopped_by, flat)
