"""A search near the best of some policies, in the few directions that the policy names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from simbias.core import Objective, Optimizer, Policy
from simbias.core.records import Array, Optimum


class Around(Objective):
    """Costs of the policies theta + z @ directions within their box, by z (d,)."""

    def __init__(self, objective: Objective, policy: Policy, theta: Array) -> None:
        self._objective, self._box, self._theta = objective, policy.bounds, theta
        self._directions = policy.directions(theta)
        self.lockstep, self.fresh, self.size = objective.lockstep, objective.fresh, len(self._directions)
        if objective.first_stage is not None:
            self.first_stage = Around(objective.first_stage, policy, theta)

    @property
    def steps(self) -> int:  # type: ignore[override]
        """Steps simulated so far."""
        return self._objective.steps

    def policies(self, z: Array) -> Array:
        """The policies (..., p) of z (..., d)."""
        return np.clip(self._theta + z @ self._directions, *self._box)

    def together(self, thetas: Array) -> Array:
        """Costs (k,) of z (k, d)."""
        return self._objective.together(self.policies(thetas))

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) that rank z (k, d)."""
        return self._objective.rank(self.policies(thetas))


def minimize(
    optimizer: Optimizer,
    objective: Objective,
    policy: Policy,
    rng: np.random.Generator,
    target_cost: float,
    candidates: Iterable[Array],
) -> Optimum:
    """The optimum in the policy's box or, if the policy names directions, near the best candidate (p,).

    Candidates are then evaluated in addition to the optimizer's budget.
    """
    known = list(candidates)
    if not known or not len(policy.directions(known[0])):
        return optimizer.minimize(objective, *policy.bounds, rng, target_cost, known)
    best = known[int(np.argmin(objective.together(np.array(known))))]
    around = Around(objective, policy, best)
    edge = np.ones(around.size)
    found = optimizer.minimize(around, -edge, edge, rng, target_cost, [np.zeros(around.size)])
    theta = around.policies(found.parameters)
    return replace(found, parameters=theta, evaluations=found.evaluations + len(known))
