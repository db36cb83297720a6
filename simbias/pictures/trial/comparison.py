"""Hardware experiments beside their simulations, and the names of both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from simbias.core.messages import counted
from simbias.core.records import Flags, Iteration, Rollout
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import HARDWARE, NOMINAL, SIMULATION, seconds
from simbias.trial.study import Study


class NamedRollout(NamedTuple):
    """A rollout, with its name and style."""

    name: str
    rollout: Rollout
    color: str = HARDWARE
    line: Literal["-", "--", ":"] = "-"


def cost_limit(study: Study) -> float:
    """Z_max, which separates successes from failures; inf if the task itself decides success."""
    return np.inf if study.task.says_success else study.cost.max_cost


def cost_markers(study: Study, experiments: Sequence[Rollout]) -> Iterator[tuple[str, Flags]]:
    """Markers of experiments' costs, and which (k,) have them: crosses if the limit does not show failure."""
    limit = cost_limit(study)
    missed = np.array([each.cost < limit and not study.passes(each) for each in experiments], np.bool_)
    yield from ((marker, some) for marker, some in (("o", ~missed), ("X", missed)) if some.any())


def simulated(study: Study, iteration: Iteration, experiments: Sequence[Rollout]) -> list[Rollout]:
    """Experiments of an iteration repeated in its policy's simulation, from equal starts; [] without one."""
    model = iteration.model
    if model is None or not experiments:
        return []
    thetas = np.array([rollout.parameters for rollout in experiments])
    starts = np.array([rollout.states[0] for rollout in experiments])
    own = study.designed_on(model)
    rollouts = own.simulator(model.bias, model.nominal).rollouts(thetas, starts)
    return [replace(rollout, cost=study.cost.of(rollout)) for rollout in rollouts]


def on_nominal(study: Study, iteration: Iteration, experiment: Rollout) -> NamedRollout:
    """An experiment of an iteration repeated on the nominal model alone, from the same start."""
    own = study.designed_on(iteration.model)
    rollout = own.simulate(experiment.parameters, None, experiment.states[0])
    return NamedRollout("nominal model alone", rollout, NOMINAL, ":")


def in_simulation(
    study: Study, iterations: Sequence[Iteration], iteration: Iteration, experiment: Rollout
) -> NamedRollout | None:
    """An experiment repeated in its policy's simulation, from the same start; None without one."""
    model = iteration.model
    if model is None:
        return None
    own = study.designed_on(model)
    rollout = own.simulate(experiment.parameters, model.bias, experiment.states[0], model.nominal)
    corrected = has_samples(iterations, iteration) and study.choices["bias"] != "none"
    bias = f" + learned bias ({study.choices['bias']})" if corrected else ""
    name = f"simulation: {'identified' if model.nominal.estimates else 'nominal'} model{bias}"
    return NamedRollout(name, rollout, SIMULATION, "--")


def has_samples(iterations: Sequence[Iteration], iteration: Iteration) -> bool:
    """Whether an iteration's policy used a learned bias: from earlier D, or from random experiments."""
    if iteration.index == 0:
        return iteration.total_experiments > len(iteration.experiments)
    before = [each.learning for each in iterations if each.index == iteration.index - 1]
    return any(learning is not None and len(learning.data) > 0 for learning in before)


def learned_before(iterations: Sequence[Iteration], iteration: Iteration) -> bool:
    """Whether an iteration's policy was made in a simulation learned from experiments."""
    model = iteration.model
    if model is None:
        return False
    return bool(model.nominal.estimates) or has_samples(iterations, iteration)


def on_hardware(iterations: Sequence[Iteration]) -> list[Iteration]:
    """The iterations whose policy was tried on the hardware; a NoPictureError if there is none."""
    tried = [iteration for iteration in iterations if policy_experiments(iteration)]
    if not tried:
        raise NoPictureError("no policy was tried on the hardware")
    return tried


def first_and_last(iterations: Sequence[Iteration]) -> list[Iteration]:
    """The first and the last iteration, if these differ."""
    return [iterations[0], *iterations[1:][-1:]]


def policy_experiments(iteration: Iteration) -> list[Rollout]:
    """The experiments of an iteration's final policy; it may have tried others too."""
    theta = iteration.parameters
    return [rollout for rollout in iteration.experiments if np.array_equal(rollout.parameters, theta)]


def worst_experiment(study: Study, iteration: Iteration) -> Rollout:
    """The most costly experiment of an iteration's final policy, among those that are no success, if any."""
    return max(policy_experiments(iteration), key=lambda each: (not study.passes(each), each.cost))


def policy_words(iteration: Iteration) -> str:
    """A policy's name, by the experiments it was learned from."""
    before = iteration.total_experiments - len(iteration.experiments)
    if iteration.model is None:
        return f"Policy of iteration {iteration.index}"
    if before == 0:
        known = bool(iteration.model.nominal.estimates)
        return "Policy from the identified model alone" if known else "Policy from simulation alone"
    return f"Policy after {counted(before, 'hardware experiment')}"


def hardware_words(study: Study) -> str:
    """The hardware's name, in words."""
    return f"hardware: {study.choices['hardware']}"


def failure_words(study: Study, rollout: Rollout) -> str:
    """The reason why a rollout failed; empty if it did not."""
    return "" if rollout.failure is None else study.task.words(rollout.failure)


def outcome_words(study: Study, rollout: Rollout) -> str:
    """How a hardware experiment ended."""
    if rollout.failed_at is not None:
        return f"fails on hardware after {seconds(study.task, rollout.failed_at):.2f} s"
    if (succeeds := study.task.succeeds(rollout.states)) is not None:
        return f"{'reaches' if succeeds else 'misses'} its goal on hardware"
    if study.passes(rollout):
        return f"lasts all {seconds(study.task, rollout.frames):g} s on hardware"
    return f"too costly on hardware (Z = {rollout.cost:.3g})"


def compared_words(study: Study, iteration: Iteration) -> str:
    """A policy and how its worst experiment ended."""
    return f"{policy_words(iteration)}: {outcome_words(study, worst_experiment(study, iteration))}"
