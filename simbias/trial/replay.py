"""Searches that a trial made before, and need not make again."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

import numpy as np

from simbias.core import Optimizer
from simbias.core.evaluations import Evaluations
from simbias.core.records import Array, Optimum


class RecallingOptimizer(Optimizer):
    """An optimizer whose optima are kept, and searched but once."""

    def __init__(self, optimizer: Optimizer) -> None:
        self._optimizer = optimizer
        self.max_evaluations = optimizer.max_evaluations
        self.relative_tolerance = optimizer.relative_tolerance
        self.max_steps, self.max_seconds = optimizer.max_steps, optimizer.max_seconds

    @abstractmethod
    def recall(self) -> Optimum | None:
        """The optimum of the trial's next search, if it was made before."""

    @abstractmethod
    def keep(self, optimum: Optimum) -> None:
        """Keep the optimum of a search, before anyone sees it."""

    def search(self, evaluations: Evaluations, rng: np.random.Generator) -> str:
        """Search as the optimizer does."""
        return self._optimizer.search(evaluations, rng)

    def minimize(
        self,
        objective: Callable[[Array], float],
        lower: Array,
        upper: Array,
        rng: np.random.Generator,
        satisfactory: float = np.inf,
        candidates: Sequence[Array] = (),
    ) -> Optimum:
        """The optimum, or the one that was found in its place before."""
        optimum = self.recall()
        if optimum is None:
            optimum = self._optimizer.minimize(objective, lower, upper, rng, satisfactory, candidates)
            self.keep(optimum)
        return optimum
