"""Predict a policy's cost from several rollouts that differ in all that is uncertain."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from simbias.core import Cost, Evaluation, Model, Objective, Simulator, Task
from simbias.core.ranges import Count, RolloutSeconds, Share
from simbias.core.records import Array, Indices
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.noise import QUIET, Noise, Variances

Aggregate = Literal["mean", "max", "cvar"]


@dataclass(frozen=True, eq=False)
class Scenario:
    """A model that might be right, its noise, and a start."""

    simulator: Simulator
    start: Array  # (n,)


class CostOfScenarios(Objective):
    """An aggregate of a policy's costs Z (Eq. 8) in K scenarios, which are the same for every policy.

    A policy that failed in each of the first `screening` scenarios is judged by these alone. If `draw` is
    given, it ranks policies in scenarios that it draws for each call.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        cost: Cost,
        worst: int,
        screening: int,
        draw: Callable[[], Sequence[Scenario]] | None = None,
    ) -> None:
        self._meet(scenarios)
        self._cost = cost
        self._worst = worst  # number of the worst costs, which are averaged
        self._screening = screening
        self._share_promising = 0.0  # of the last policies: says how to simulate, and changes no cost
        self._draw = draw
        self.fresh = draw is not None

    def _meet(self, scenarios: Sequence[Scenario]) -> None:
        """Let policies run in these scenarios."""
        self.scenarios = scenarios
        self._simulators = join([scenario.simulator for scenario in scenarios])
        self._starts = np.array([scenario.start for scenario in scenarios])  # (K, n)

    def rank(self, thetas: Array) -> Array:
        """Costs (k,) of thetas (k, p): in the same scenarios or, if fresh, in those of this call alone."""
        if self._draw is None:
            return self.together(thetas)
        other = copy(self)
        other._meet(self._draw())
        costs = other.together(thetas)
        self.steps, self._share_promising = other.steps, other._share_promising
        return costs

    def together(self, thetas: Array) -> Array:
        """The costs (k,) of thetas (k, p); all policies in all scenarios run in lockstep."""
        costs = np.zeros((len(thetas), len(self.scenarios)))
        every = np.arange(len(self.scenarios))
        first, others = every[: self._screening], every[self._screening :]
        if self._share_promising > 0.5:  # enough in lockstep for it to pay to simulate some in vain
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
        """The means (k,) of the worst of the costs (k, .)."""
        return np.mean(np.sort(costs)[:, -self._worst :], axis=1)


class Robust(Evaluation):
    """An aggregate of the costs of `rollouts` rollouts: common random numbers in all of a search.

    Each has its own noise and, if it is sampled, its own start, nominal model and bias.

    Parameters
    ----------
    noise
        Variances on the inputs and on the sensors of the simulated rollouts, by name (`Noise`).
    aggregate
        The mean, the max, or "cvar": the mean of the worst `tail` of the costs.
    screening
        Rollouts after which a policy that failed in all of them is not simulated any further.
    fresh
        CMA-ES ranks each generation in scenarios of its own, so that no search fits its policies to a few.
        The generations' means are judged in those that are common, and the best of them is found.
    seconds
        That the rollouts take at most, so that policies are found that last; None is the task's horizon.
    """

    def __init__(
        self,
        task: Task,
        rollouts: Count = 8,
        noise: Variances = QUIET,
        aggregate: Aggregate = "mean",
        tail: Share = 0.25,
        sample_starts: bool = True,
        sample_nominal: bool = False,
        sample_bias: bool = False,
        screening: Count = 2,
        seconds: RolloutSeconds | None = None,
        fresh: bool = False,
    ) -> None:
        if seconds is not None:
            task = task.with_horizon(task.frames(seconds))
            self.horizon = task.horizon
        self._task = task
        self.rollouts = rollouts
        self._noise = Noise(task, noise)
        self._worst = {"mean": rollouts, "max": 1, "cvar": math.ceil(tail * rollouts)}[aggregate]
        self._sample_starts = sample_starts
        self._sample_nominal = sample_nominal
        self._sample_bias = sample_bias
        self._screening = screening
        self._fresh = fresh

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """The aggregated cost in scenarios that are drawn here, once; fresh ones when they are met."""
        if self.horizon is not None:
            model, cost = replace(model, task=self._task), cost.with_horizon(self.horizon)

        def draw() -> list[Scenario]:
            return [self._scenario(model, scenario_rng) for scenario_rng in rng.spawn(self.rollouts)]

        fresh = draw if self._fresh else None
        return CostOfScenarios(draw(), cost, self._worst, self._screening, fresh)

    def _scenario(self, model: Model, rng: np.random.Generator) -> Scenario:
        """Draw what is uncertain; what is not asked for changes nothing in the rest."""
        start_rng, noise_rng, nominal_rng, bias_rng = rng.spawn(4)
        task = self._task
        start = task.draw_start(start_rng) if self._sample_starts else task.start_mean
        disturbance = None if self._noise.is_silent else self._noise.draw(noise_rng)
        drawn = replace(
            model,
            nominal=model.nominal.draw(nominal_rng) if self._sample_nominal else model.nominal,
            bias=model.bias.draw(bias_rng) if self._sample_bias else model.bias,
        )
        return Scenario(simulator(drawn, disturbance), start)
