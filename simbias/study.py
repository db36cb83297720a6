"""A study: the components of a trial, composed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simbias.config import Composition
from simbias.interfaces import (
    Bias,
    Cost,
    Evaluation,
    FittedBias,
    Hardware,
    Method,
    Nominal,
    Observer,
    Optimizer,
    Policy,
    Samples,
    Simulator,
    Task,
    Tracking,
)
from simbias.records import Array, Iteration, Rollout, Transitions
from simbias.simulation.closed_loop import Model


class Unobserved:
    """An observer that ignores everything."""

    def searching(self, evaluations: int, best_cost: float) -> None:
        """Ignore a search's progress."""

    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """Ignore an experiment."""


@dataclass(frozen=True, eq=False)
class Study:
    """The components of a trial."""

    task: Task
    nominal: Nominal
    hardware: Hardware
    policy: Policy
    samples: Samples
    bias: Bias
    cost: Cost
    evaluation: Evaluation
    optimizer: Optimizer
    method: Method
    tracking: Tracking
    seed: int
    composition: Composition  # what the components were built from

    @property
    def config(self) -> Mapping[str, Any]:
        """The plain, resolved config."""
        return self.composition.config

    @property
    def choices(self) -> Mapping[str, str]:
        """The chosen option of every group."""
        return self.composition.choices

    @property
    def title(self) -> str:
        """The choices that tell trials apart, in a few words."""
        choices = self.choices
        return (
            f"{choices['method']} on {choices['task']}: nominal {choices['nominal']}, "
            f"hardware {choices['hardware']}, bias {choices['bias']}, optimizer {choices['optimizer']}"
        )

    @property
    def hash(self) -> str:
        """The trial's identity: a hash of everything that affects its result."""
        return self.composition.hash

    def run(self, observer: Observer | None = None) -> Iterator[Iteration]:
        """Run the method; the same seed gives the same records."""
        return self.method.run(self, np.random.default_rng(self.seed), observer or Unobserved())

    def simulate(
        self, theta: Array, fitted_bias: FittedBias | None = None, start: Array | None = None
    ) -> Rollout:
        """Roll theta (p,) out in simulation, without noise (Eq. 7, 9).

        Without a fitted bias g = 0; without a start (n,) it is the task's mean start.
        """
        rollout = self.simulator(fitted_bias).rollout(
            np.asarray(theta, dtype=np.float64), self.task.start_mean if start is None else start
        )
        return replace(rollout, cost=self.cost.of(rollout))

    def experiment(self, theta: Array, rng: np.random.Generator) -> Rollout:
        """Run theta (p,) on the hardware once, from a random start."""
        rollout = self.hardware.run(self.policy, theta, self.task.draw_start(rng), rng)
        return replace(rollout, cost=self.cost.of(rollout))

    def simulator(self, fitted_bias: FittedBias | None = None) -> Simulator:
        """The closed loop on the nominal model, corrected by a fitted bias; g = 0 without one."""
        return self.model(fitted_bias).simulator()

    def model(self, fitted_bias: FittedBias | None = None) -> Model:
        """The nominal model, corrected by a fitted bias; g = 0 without one."""
        return Model(self.task, self.policy, self.nominal, fitted_bias or self.bias.fit(self.no_data))

    def warm_up(self) -> None:
        """Compile what a simulated rollout needs, so that a search does not begin with it."""
        self.simulate(np.zeros(self.policy.n_parameters))

    @property
    def no_data(self) -> Transitions:
        """D = {}."""
        return Transitions.empty(len(self.task.states), len(self.task.inputs))
