"""Predict a policy's cost from several rollouts with sampled uncertainties (domain randomization)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from simbias.core import Cost, Evaluation, Model, Objective, Task
from simbias.core.ranges import Count, RolloutSeconds, Share
from simbias.search.evaluation.nominal_start import NominalStart
from simbias.search.evaluation.scenarios import CostOfScenarios, Scenario
from simbias.simulation.closed_loop import simulator
from simbias.simulation.noise import QUIET, Noise, Variances

Aggregate = Literal["mean", "max", "cvar"]


class Robust(Evaluation):
    """An aggregate of the costs of `rollouts` rollouts, with common random numbers throughout a search.

    Each rollout has its own noise and, if sampled, its own start, nominal model and bias.

    Parameters
    ----------
    noise
        Variances on the inputs and on the sensors of the simulated rollouts, by name (`Noise`).
    aggregate
        The mean, the max, or "cvar": the mean of the worst `tail` of the costs.
    screening
        Number of rollouts; a policy that fails in all of them is not simulated further.
    fresh
        Whether CMA-ES ranks each generation in newly drawn scenarios, to avoid overfitting to a few. The
        generations' means are evaluated in the common scenarios, and the best mean is the result.
    from_nominal
        Whether a search begins at the optimum for one noise-free rollout on the model itself from the mean
        start.
    seconds
        The maximum duration of the rollouts; longer ones favour policies that last. None: the task's horizon.
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
        from_nominal: bool = False,
    ) -> None:
        if seconds is not None:
            task = task.with_horizon(task.frames(seconds))
            self.horizon = task.horizon
        self._task = task
        self.rollouts = rollouts
        self._noise = Noise(task, noise)
        self._worst = {"mean": rollouts, "max": 1, "cvar": math.ceil(tail * rollouts - 1e-9) or 1}[aggregate]
        self._sample_starts = sample_starts
        self.draws_nominal = sample_nominal
        self._sample_bias = sample_bias
        self._screening = screening
        self._fresh = fresh
        self._from_nominal = from_nominal

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """The aggregated cost in scenarios that are drawn here, once; fresh ones are drawn at each call."""
        if self.horizon is not None:
            model, cost = replace(model, task=self._task), cost.with_horizon(self.horizon)

        def draw() -> list[Scenario]:
            return [self._scenario(model, scenario_rng) for scenario_rng in rng.spawn(self.rollouts)]

        easier = NominalStart(self._task).objective(model, cost, rng) if self._from_nominal else None
        fresh = draw if self._fresh else None
        return CostOfScenarios(draw(), cost, self._worst, self._screening, fresh, easier)

    def _scenario(self, model: Model, rng: np.random.Generator) -> Scenario:
        """Draw the uncertain parts; switching one off does not change the draws of the others."""
        start_rng, noise_rng, nominal_rng, bias_rng = rng.spawn(4)
        task = self._task
        start = task.draw_start(start_rng) if self._sample_starts else task.start_mean
        disturbance = None if self._noise.is_silent else self._noise.draw(noise_rng)
        drawn = replace(
            model,
            nominal=model.nominal.draw(nominal_rng) if self.draws_nominal else model.nominal,
            bias=model.bias.draw(bias_rng) if self._sample_bias else model.bias,
        )
        return Scenario(simulator(drawn, disturbance), start)
