"""Hardware experiments beside the same in simulation, and what to call them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simbias.interfaces import FittedBias
from simbias.pictures.style import seconds
from simbias.records import Array, Iteration, Rollout
from simbias.study import Study


def simulated(study: Study, iteration: Iteration) -> list[Rollout]:
    """Each experiment's policy from its start, in the simulation that the policy was optimised in."""
    starts = np.array([rollout.states[0] for rollout in iteration.experiments])
    thetas = np.tile(iteration.optimum.parameters, (len(starts), 1))
    rollouts = study.simulator(iteration.fitted_bias).rollouts(thetas, starts)
    return [replace(rollout, cost=study.cost.of(rollout)) for rollout in rollouts]


def corrections(fitted_bias: FittedBias, states: Array, inputs: Array) -> Array:
    """The last term (k, n) of Eq. 7 at states (k, n) under inputs (k, m), as a search adds it."""
    if fitted_bias.kernel is None:
        return np.array([fitted_bias.correction(x, u) for x, u in zip(states, inputs, strict=True)])
    found = np.empty_like(states)
    fitted_bias.kernel.function(states, inputs, fitted_bias.kernel.parameters, found)
    return found


def first_and_last(iterations: Sequence[Iteration]) -> list[Iteration]:
    """The iterations of the first policy and of the last, if these are two."""
    return [iterations[0], *iterations[1:][-1:]]


def worst(iteration: Iteration) -> Rollout:
    """The most expensive experiment."""
    return max(iteration.experiments, key=lambda rollout: rollout.cost)


def experiments_before(iteration: Iteration) -> int:
    """How many hardware experiments a policy could learn from."""
    return iteration.total_experiments - len(iteration.experiments)


def policy_words(iteration: Iteration) -> str:
    """What a policy rests on."""
    before = experiments_before(iteration)
    return f"Policy after {before} hardware experiments" if before else "Policy from simulation alone"


def simulation_words(study: Study, iteration: Iteration) -> str:
    """The simulation that a policy was optimised in."""
    learned = f" + learned bias ({study.choices['bias']})" if experiments_before(iteration) else ""
    return f"simulation: nominal model{learned}"


def hardware_words(study: Study) -> str:
    """The hardware."""
    return f"hardware: {study.choices['hardware']}"


def outcome_words(study: Study, rollout: Rollout) -> str:
    """What came out on hardware."""
    if rollout.failed_at is not None:
        return f"fails on hardware after {seconds(study.task, rollout.failed_at):.2f} s"
    if rollout.cost < study.cost.max_cost:
        return f"lasts all {seconds(study.task, rollout.frames):g} s on hardware"
    return f"too costly on hardware (Z = {rollout.cost:.3g})"
