"""Targets of an experiment: known to the policy, kept in the record, absent from the hardware."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import final

import numpy as np

from simbias.core import Law, Policy, Quantity
from simbias.core.records import Array, Rollout


@final
class WithTargets(Policy):
    """The policy of a task with targets, for an episode whose targets (k,) it knows."""

    def __init__(self, policy: Policy, targets: Array, quantities: Sequence[Quantity]) -> None:
        self.policy, self.targets = policy, targets
        named = zip(quantities, targets, strict=True)
        self.texts = [f"{quantity.name} = {value:g} {quantity.unit}" for quantity, value in named]
        self.n_parameters, self.bounds = policy.n_parameters, policy.bounds
        self.state_size = policy.state_size

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at the robot's states x (..., n), and the policy state for the next frame."""
        targets = np.broadcast_to(self.targets, (*x.shape[:-1], len(self.targets)))
        return self.policy.act(theta, np.concatenate([x, targets], axis=-1), t, policy_state)

    def law(self, theta: Array) -> Law:
        """The policy's law, with the targets."""
        law = self.policy.law(theta)
        return Law(f"{law.words}; targets: {', '.join(self.texts)}", {**law.numbers, "targets": self.targets})


def beside(rollout: Rollout, targets: Array) -> Rollout:
    """A robot's rollout with targets (k,) appended to its states and measurements in each frame."""
    if not len(targets):
        return rollout

    def with_targets(states: Array) -> Array:
        return np.hstack([states, np.tile(targets, (len(states), 1))])

    measured = None if rollout.measured is None else with_targets(rollout.measured)
    noise = None if rollout.noise is None else np.append(rollout.noise, np.zeros(len(targets)))
    return replace(rollout, states=with_targets(rollout.states), measured=measured, noise=noise)
