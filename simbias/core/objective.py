"""Objectives of policy searches: the cost of each of some policies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from simbias.core.records import Array


class Objective(ABC):
    """The deterministic objective of a policy search. A plain function of theta (p,) will do, too."""

    steps: int = 0  # simulated so far, for searches that are limited by them
    lockstep: bool = True  # whether the costs of many policies together take less time than one by one
    fresh: bool = False  # whether `rank` draws scenarios of its own
    first_stage: Objective | None = None  # an easier one, at whose optimum a search of this one begins

    @abstractmethod
    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank thetas (k, p) among each other; of another call's, fresh ones tell nothing."""
        return self.together(thetas)

    def __call__(self, theta: Array) -> float:
        """Cost of theta (p,)."""
        return float(self.together(theta[None])[0])


class OneByOne(Objective):
    """A plain function of theta (p,) as an objective."""

    lockstep = False

    def __init__(self, function: Callable[[Array], float]) -> None:
        self._function = function

    @property
    def steps(self) -> int:  # type: ignore[override]
        """Simulated so far, if the function counts them."""
        return getattr(self._function, "steps", 0)

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p), in turn."""
        return np.array([float(self._function(theta)) for theta in thetas])


class Mapped(Objective):
    """Another objective's costs, each time changed by a function of thetas (k, p) and costs (k,)."""

    def __init__(
        self, objective: Callable[[Array], float], function: Callable[[Array, Array], Array]
    ) -> None:
        self._objective, self._function = as_objective(objective), function
        self.lockstep, self.fresh = self._objective.lockstep, self._objective.fresh
        self.first_stage = self._objective.first_stage

    @property
    def steps(self) -> int:  # type: ignore[override]
        """Simulated so far."""
        return self._objective.steps

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""
        return self._function(thetas, self._objective.together(thetas))

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank thetas (k, p) among each other."""
        return self._function(thetas, self._objective.rank(thetas))


def as_objective(function: Callable[[Array], float]) -> Objective:
    """The function itself if it is an objective."""
    return function if isinstance(function, Objective) else OneByOne(function)
