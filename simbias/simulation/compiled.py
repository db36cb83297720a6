"""Closed-loop rollouts without Python in them (Eq. 7, 9), sixteen in step on each thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simbias.core import Cost, Kernel, Model, Nominal, Task
from simbias.core.records import Array, Disturbance, Indices, Rollout
from simbias.simulation.compiler.fused import Composition, compiled_loop, rows
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.threads import in_threads
from simbias.simulation.compiler.tracing import PolicyKernel, of_cost, parts_of
from simbias.simulation.numpy_loop import costs_of, record

NOTHING = np.empty((0, LANES))  # kept of earlier rollouts
RECORDED = 256  # rollouts recorded at once: their records take memory


@dataclass(frozen=True, eq=False)
class CompiledSimulator:
    """The closed loop of components that all have kernels, own or traced, in one world or in several."""

    task: Task
    measure: Kernel
    policy: PolicyKernel
    memory: int  # s of the policy
    hidden: int  # s of the nominal model
    nominal: Kernel  # its parameters (w, .) in each world
    bias: Kernel
    noise: Array  # (w, T+1, m+n) on the inputs and on the sensors; (w, 0, m+n) without noise
    models: tuple[Nominal, ...]  # held on to: a kernel's parameters may be addresses of what is theirs
    cost: Cost | None = None  # summed up of recorded rollouts, too: one loop is compiled for both

    @staticmethod
    def of(
        model: Model, disturbance: Disturbance | None, cost: Cost | None = None
    ) -> CompiledSimulator | None:
        """The model's closed loop; None if one of its parts has no kernel, and none can be traced."""
        parts = parts_of(model)
        if any(part.kernel is None for part in parts):
            return None
        task, sizes = model.task, (model.policy.memory_size, model.nominal.memory_size)
        measure, policy, nominal, bias = (part.kernel for part in parts)
        rows = 0 if disturbance is None else task.horizon + 1
        noise = np.zeros((1, rows, len(task.inputs) + len(task.states)))
        if disturbance is not None:
            noise[0, :-1, : len(task.inputs)] = disturbance.inputs
            noise[0, :, len(task.inputs) :] = disturbance.sensors
        nominal = Kernel(nominal.function, nominal.parameters[None])
        return CompiledSimulator(task, measure, policy, *sizes, nominal, bias, noise, (model.nominal,), cost)

    @staticmethod
    def join(simulators: Sequence[CompiledSimulator]) -> CompiledSimulator | None:
        """Simulators in step; None if they differ in more than the nominal parameters and the noise."""
        first = simulators[0]
        if not all(map(first._runs_in_step_with, simulators)):
            return None
        parameters = np.concatenate([simulator.nominal.parameters for simulator in simulators])
        return replace(
            first,
            nominal=Kernel(first.nominal.function, parameters),
            noise=np.concatenate([simulator.noise for simulator in simulators]),
            models=tuple(model for simulator in simulators for model in simulator.models),
        )

    def _runs_in_step_with(self, other: CompiledSimulator) -> bool:
        """Whether their worlds differ in nothing but the nominal parameters' values and the noise's."""
        return (
            self.task is other.task
            and self.policy is other.policy
            and self.bias.function is other.bias.function
            and self.bias.parameters is other.bias.parameters
            and self.nominal.function is other.nominal.function
            and self.hidden == other.hidden
            and self.nominal.parameters.shape[1:] == other.nominal.parameters.shape[1:]
            and self.noise.shape[1:] == other.noise.shape[1:]
        )

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon, in the first world."""
        return self.rollouts(theta[None], start[None])[0]

    def rollouts(self, thetas: Array, starts: Array, worlds: Indices | None = None) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its world of (k,), on all threads."""
        task, rollouts = self.task, []
        for first in range(0, len(thetas), RECORDED):
            some = slice(first, first + RECORDED)
            own = None if worlds is None else worlds[some]
            made = self._run(self.cost, True, thetas[some], starts[some], own)
            each = zip(made.states, made.inputs, made.frames.tolist(), made.violated.tolist(), strict=True)
            rollouts += [record(task.criteria, *one) for one in each]
        return rollouts

    def costs(
        self, cost: Cost, thetas: Array, starts: Array, worlds: Indices | None = None
    ) -> tuple[Array, Indices]:
        """Costs and frames (k,) of these rollouts; nothing is recorded if its terms can be traced."""
        if not self.sums_up(cost):
            return costs_of(cost, self.rollouts(thetas, starts, worlds))
        made = self._run(cost, False, thetas, starts, worlds)
        return made.costs(cost, self.task.horizon), made.frames

    def sums_up(self, cost: Cost) -> bool:
        """Whether the terms of a cost can be traced."""
        return of_cost(cost, self.task).kernel is not None

    def _run(
        self, cost: Cost | None, recorded: bool, thetas: Array, starts: Array, worlds: Indices | None
    ) -> Made:
        """Rollouts, recorded or not; the cost's terms are summed up, if they can be traced."""
        k = len(thetas)
        made = Made.of(k, cost, self.task, recorded)
        if recorded:
            made.states[:, 0] = starts
        loop, _ = self.loop(cost)
        each = (
            self.policy.parameters(np.asarray(thetas, dtype=np.float64)),
            np.zeros(k, np.int64) if worlds is None else worlds,
            np.ascontiguousarray(starts, dtype=np.float64),
            *made.arrays,
        )

        def run(begin: int, end: int) -> None:
            loop(*(array[begin:end] for array in each), end - begin, 0, NOTHING)

        in_threads(run, k)
        return made

    def loop(self, cost: Cost | None) -> tuple[Callable[..., None], int]:
        """The compiled loop, as a function of what differs between its calls, and the rows of its lanes."""
        task, terms = self.task, of_cost(cost, self.task).kernel if cost else None
        composition = self._composition(terms, cost)
        compiled = compiled_loop(composition)
        limits = np.array([criterion.limit for criterion in task.criteria])
        noise = self.noise.reshape(-1, len(task.inputs) + len(task.states))
        weights = terms.parameters if terms else np.empty(0)

        def loop(policies: Array, worlds: Indices, starts: Array, *rest: Any) -> None:
            compiled(
                task.horizon, task.time_step, limits,
                self.measure.parameters, self.policy.constants, policies, self.nominal.parameters,
                self.bias.parameters, weights, noise, worlds, starts, *rest,
            )  # fmt: skip

        return loop, rows(composition)

    def _composition(self, terms: Kernel | None, cost: Cost | None) -> Composition:
        """What is compiled."""
        task, bias, policy = self.task, self.bias, self.policy
        return Composition(
            measure=self.measure.function,
            control=policy.function,
            step=self.nominal.function,
            correct=bias.function,
            terms=terms.function if terms else None,
            states=len(task.states),
            inputs=len(task.inputs),
            criteria=len(task.criteria),
            reductions=cost.reductions if cost and terms else (),
            memory=self.memory,
            hidden=self.hidden,
            measure_parameters=len(self.measure.parameters),
            policy_constants=len(policy.constants),
            policy_parameters=policy.size,
            nominal_parameters=self.nominal.parameters.shape[1],
            bias_parameters=0 if isinstance(bias.parameters, tuple) else len(bias.parameters),
            cost_parameters=len(terms.parameters) if terms else 0,
            noisy=self.noise.shape[1] > 0,
        )


@dataclass(frozen=True, eq=False)
class Made:
    """What became of k rollouts."""

    states: Array  # (k, T+1, n), or nothing if they are not recorded
    inputs: Array  # (k, T, m), likewise
    totals: Array  # (k, s) of the cost
    frames: Indices  # (k,), -1 of those that have not ended
    violated: Indices  # (k,) criterion that ended it, -1 at the horizon

    @staticmethod
    def of(k: int, cost: Cost | None, task: Task, recorded: bool = False) -> Made:
        """Nothing yet, of k rollouts that are to be summed up and recorded, or not."""
        rows = k if recorded else 0
        return Made(
            np.empty((rows, task.horizon + 1, len(task.states))),
            np.empty((rows, task.horizon, len(task.inputs))),
            np.zeros((k, len(cost.reductions) if cost else 0)),
            np.full(k, -1),
            np.full(k, -1),
        )

    @property
    def arrays(self) -> tuple[Any, ...]:
        """In the order of the loop's arguments."""
        return self.states, self.inputs, self.totals, self.frames, self.violated

    def part(self, some: Sequence[int]) -> Made:
        """A copy of what became of some rollouts, none of them recorded."""
        return Made(self.states, self.inputs, self.totals[some], self.frames[some], self.violated[some])

    def put(self, some: Sequence[int], part: Made) -> None:
        """Put such a part back."""
        self.totals[some], self.frames[some], self.violated[some] = part.totals, part.frames, part.violated

    def costs(self, cost: Cost, horizon: int) -> Array:
        """Costs (k,) of the totals."""
        return cost.of_totals(self.totals, np.where(self.violated < 0, 0, horizon - self.frames))
