"""The budget of a trial's experiments, for any method."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from simbias.core.ranges import Count, Seconds


class BudgetSpent(Exception):  # noqa: N818 (no error: a trial may end this way, unsuccessfully)
    """A trial requests an experiment that its budget does not allow."""


@dataclass(frozen=True)
class Budget:
    """Limits on a trial's hardware experiments and their seconds, for any method; None: no limit."""

    experiments: Count | None = None
    seconds: Seconds | None = None  # once they are spent, no experiment begins

    def spent(self, experiments: int, seconds: float) -> list[str]:
        """The limits, by name, that allow no more than this many experiments and seconds."""
        made = {"experiments": experiments, "seconds": seconds}
        return [name for name, amount in made.items() if amount >= (getattr(self, name) or inf)]


NO_LIMITS = Budget()


@dataclass
class Spending:
    """The part of a trial's budget that is spent: experiments, and their seconds on hardware."""

    budget: Budget = NO_LIMITS
    experiments: int = 0
    frames: int = 0
    seconds: float = 0.0

    def check(self) -> None:
        """Raise BudgetSpent if the budget is spent; called before steps that lead to an experiment."""
        if self.budget.spent(self.experiments, self.seconds):
            raise BudgetSpent

    def add(self, frames: int, time_step: float) -> None:
        """Count an experiment of this many frames."""
        self.experiments += 1
        self.frames += frames
        self.seconds = time_step * self.frames  # as in summaries; a sum of durations would be rounded
