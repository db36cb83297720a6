"""Closed-loop rollouts in simulation (Eq. 7, 9): compiled if all parts have kernels, else in NumPy."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simbias.core import Cost, Model, Simulator, StudyWarning
from simbias.core.records import Array, Disturbance, Indices
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler import parts_of
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import corrections


def simulator(model: Model, disturbance: Disturbance | None = None, cost: Cost | None = None) -> Simulator:
    """The compiled closed loop if every part has a kernel or can be traced, else the plain one in NumPy.

    Given a search's cost, it compiles the same loop as the search.
    """
    compiled = CompiledSimulator.of(model, disturbance, cost)
    return compiled or PlainSimulator([model], [disturbance], corrections)


def join(simulators: Sequence[Simulator]) -> Scenarios:
    """Combine simulators for a policy search: in lockstep, if they share enough.

    Compiled ones must share everything except the nominal model's parameters and the noise.
    """
    compiled = [simulator for simulator in simulators if isinstance(simulator, CompiledSimulator)]
    plain = [simulator for simulator in simulators if isinstance(simulator, PlainSimulator)]
    if plain:
        _say_what_is_slow(plain[0].models[0])
    if len(compiled) == len(simulators):
        return CompiledSimulator.join(compiled) or SimulatorSequence(simulators)
    if len(plain) == len(simulators):
        models = [model for simulator in plain for model in simulator.models]
        disturbances = [d for simulator in plain for d in simulator.disturbances]
        return PlainSimulator(models, disturbances, plain[0].correct)
    return SimulatorSequence(simulators)


def _say_what_is_slow(model: Model) -> None:
    """Warn of the parts of a closed loop that prevent its compilation."""
    reasons = "; ".join(part.why_not for part in parts_of(model) if part.kernel is None)
    message = (
        f"simulated in NumPy, up to 500 times slower than compiled, as it cannot be compiled: {reasons}; "
        "see simbias/simulation/compiler/kernels.py for what can"
    )
    warnings.warn(message, StudyWarning, stacklevel=3)


@dataclass(frozen=True, eq=False)
class SimulatorSequence:
    """Simulators that have to run one after the other."""

    simulators: Sequence[Simulator]

    def costs(self, cost: Cost, thetas: Array, starts: Array, scenarios: Indices) -> tuple[Array, Indices]:
        """Costs and frames (k,) of each theta of (k, p) from its start of (k, n) in its scenario of (k,)."""
        costs, frames = np.empty(len(thetas)), np.empty(len(thetas), np.int64)
        for index, simulator in enumerate(self.simulators):
            own = scenarios == index
            costs[own], frames[own] = simulator.costs(cost, thetas[own], starts[own])
        return costs, frames


Scenarios = CompiledSimulator | PlainSimulator | SimulatorSequence  # of one task, run together
