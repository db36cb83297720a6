"""The budget of a trial's experiments, for any method."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from simbias.core.ranges import Count, Seconds


class BudgetSpent(Exception):  # noqa: N818 (no error: a trial that ends so has not succeeded)
    """A trial asks for an experiment that its budget does not allow."""


@dataclass(frozen=True)
class Budget:
    """Experiments on hardware that a trial may make by any method, and their seconds; None: no limit."""

    experiments: Count | None = None
    seconds: Seconds | None = None  # after which no experiment begins


NO_LIMITS = Budget()


@dataclass
class Spending:
    """Experiments that a trial has made of its budget, and their seconds on hardware."""

    budget: Budget = NO_LIMITS
    experiments: int = 0
    seconds: float = 0.0

    def check(self) -> None:
        """Raise BudgetSpent if the budget is spent: what follows leads to another experiment."""
        limits = self.budget.experiments or inf, self.budget.seconds or inf
        if self.experiments >= limits[0] or self.seconds >= limits[1]:
            raise BudgetSpent

    def add(self, seconds: float) -> None:
        """Count an experiment of so many seconds."""
        self.experiments += 1
        self.seconds += seconds
