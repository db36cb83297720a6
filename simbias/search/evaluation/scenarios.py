"""The cost of a policy in scenarios: drawn models, each with its noise and start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from simbias.core import Cost, Objective, Simulator
from simbias.core.records import Array, Indices
from simbias.simulation.closed_loop import join


@dataclass(frozen=True, eq=False)
class Scenario:
    """A drawn model, its noise, and a start."""

    simulator: Simulator
    start: Array  # (n,)


class CostOfScenarios(Objective):
    """An aggregate of a policy's costs Z (Eq. 8) in K scenarios, which are the same for every policy.

    A policy that fails in each of the first `screening` scenarios is judged by these alone. If `draw` is
    given, policies are ranked in scenarios drawn for each call.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        cost: Cost,
        worst: int = 1,
        screening: int = 1,
        draw: Callable[[], Sequence[Scenario]] | None = None,
        first_stage: Objective | None = None,
    ) -> None:
        self._meet(scenarios)
        self.first_stage = first_stage
        self._draw, self.fresh = draw, draw is not None
        self._cost = cost
        self._worst = worst  # number of worst costs to average
        self._screening = screening
        self._share_promising = 0.0  # of the last policies: it affects how they are simulated, but no cost

    def _meet(self, scenarios: Sequence[Scenario]) -> None:
        """Set the scenarios in which policies run."""
        self.scenarios = scenarios
        self._simulators = join([scenario.simulator for scenario in scenarios])
        self._starts = np.array([scenario.start for scenario in scenarios])  # (K, n)

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p): in the common scenarios or, if fresh, in newly drawn ones."""
        if self._draw is None:
            return self.together(thetas)
        other = copy(self)
        other._meet(self._draw())
        costs = other.together(thetas)
        self.steps, self._share_promising = other.steps, other._share_promising
        return costs

    def together(self, thetas: Array) -> Array:
        """The costs (k,) of thetas (k, p); all policies in all scenarios run in lockstep."""
        every = np.arange(len(self.scenarios))
        if len(every) <= self._screening:
            return self._aggregated(self._costs(thetas, every))
        costs = np.zeros((len(thetas), len(every)))
        first, others = every[: self._screening], every[self._screening :]
        if self._share_promising > 0.5:  # simulating all in lockstep pays, even if some are wasted
            costs = self._costs(thetas, every)
            hopeless = costs[:, first].min(axis=1) > self._cost.max_cost
        else:
            costs[:, first] = self._costs(thetas, first)
            hopeless = costs[:, first].min(axis=1) > self._cost.max_cost
            costs[np.ix_(~hopeless, others)] = self._costs(thetas[~hopeless], others)
        self._share_promising = 1 - np.mean(hopeless)
        return np.where(hopeless, self._aggregated(costs[:, first]), self._aggregated(costs))

    def _costs(self, thetas: Array, scenarios: Indices) -> Array:
        """The cost of each theta of (k, p) in each of the scenarios."""
        each = np.tile(scenarios, len(thetas))
        repeated = np.repeat(thetas, len(scenarios), axis=0)
        costs, frames = self._simulators.costs(self._cost, repeated, self._starts[each], each)
        self.steps += int(frames.sum())
        return costs.reshape(len(thetas), len(scenarios))

    def _aggregated(self, costs: Array) -> Array:
        """The means (k,) of the worst costs among (k, .)."""
        return np.mean(np.sort(costs)[:, -self._worst :], axis=1)
