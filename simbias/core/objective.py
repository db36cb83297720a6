"""Objectives of policy searches: the costs of policies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from simbias.core.records import Array


class Objective(ABC):
    """The deterministic objective of a policy search; a plain function of theta (p,) may take its place."""

    steps: int = 0  # simulated so far, for searches that are limited by them
    lockstep: bool = True  # whether evaluating many policies together is faster than one by one
    fresh: bool = False  # whether `rank` draws new scenarios at each call
    first_stage: Objective | None = None  # an easier objective; a search of this one begins at its optimum

    @abstractmethod
    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank thetas (k, p); fresh ones are comparable only within one call."""
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
        """Steps simulated so far, if the function counts them."""
        return getattr(self._function, "steps", 0)

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p), evaluated one by one."""
        return np.array([float(self._function(theta)) for theta in thetas])


class _OfAnother(Objective):
    """An objective whose costs come from another one's simulations."""

    def __init__(self, objective: Callable[[Array], float]) -> None:
        self._objective = as_objective(objective)
        self.lockstep, self.fresh = self._objective.lockstep, self._objective.fresh
        self.first_stage = self._objective.first_stage

    @property
    def steps(self) -> int:  # type: ignore[override]
        """Steps simulated so far."""
        return self._objective.steps


class Mapped(_OfAnother):
    """Another objective's costs, transformed by a function of thetas (k, p) and costs (k,)."""

    def __init__(
        self, objective: Callable[[Array], float], function: Callable[[Array, Array], Array]
    ) -> None:
        super().__init__(objective)
        self._function = function

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p)."""
        return self._function(thetas, self._objective.together(thetas))

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank thetas (k, p)."""
        return self._function(thetas, self._objective.rank(thetas))


class Near(_OfAnother):
    """Costs of the points theta + z @ directions (..., p) of a box, by z (d,)."""

    def __init__(
        self, objective: Callable[[Array], float], theta: Array, directions: Array, lower: Array, upper: Array
    ) -> None:
        if directions.shape != (len(directions), len(theta)) or not np.isfinite(directions).all():
            expected = f"expected finite numbers of shape (d, {len(theta)})"
            raise ValueError(f"directions: {expected}, got shape {directions.shape}")
        super().__init__(objective)
        self._theta, self._directions, self._box = theta, directions, (lower, upper)
        if self.first_stage is not None:
            self.first_stage = Near(self.first_stage, theta, directions, lower, upper)

    def points(self, z: Array) -> Array:
        """The points (..., p) of z (..., d)."""
        return np.clip(self._theta + z @ self._directions, *self._box)

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of z (k, d)."""
        return self._objective.together(self.points(thetas))

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank z (k, d)."""
        return self._objective.rank(self.points(thetas))


def as_objective(function: Callable[[Array], float]) -> Objective:
    """Wrap a plain function as an objective; an objective is returned unchanged."""
    return function if isinstance(function, Objective) else OneByOne(function)
