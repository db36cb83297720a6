"""Closed-loop rollouts without Python in them (Eq. 7, 9), sixteen in step on each thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from simbias.interfaces import Cost, Kernel, Model, Nominal, Task
from simbias.records import Array, Disturbance, Indices, Rollout
from simbias.simulation.fused import Composition, compiled_loop
from simbias.simulation.plain import costs_of, record
from simbias.simulation.threads import in_threads
from simbias.simulation.tracing import parts_of

RECORDED = 256  # rollouts recorded at once: their records take memory


@dataclass(frozen=True, eq=False)
class CompiledSimulator:
    """The closed loop of components that all have kernels, own or traced, in one world or in several."""

    task: Task
    measure: Kernel
    output: Kernel
    policy: Callable[[Array], Kernel]
    memory: int  # s of the policy
    hidden: int  # s of the nominal model
    nominal: Kernel  # its parameters (w, .) in each world
    bias: Kernel
    noise: Array  # (w, T+1, m+n) on the inputs and on the sensors; (w, 0, m+n) without noise
    models: tuple[Nominal, ...]  # held on to: a kernel's parameters may be addresses of what is theirs

    @staticmethod
    def of(model: Model, disturbance: Disturbance | None) -> CompiledSimulator | None:
        """The model's closed loop; None if one of its parts has no kernel, and none can be traced."""
        parts = parts_of(model)
        if any(part.kernel is None for part in parts):
            return None
        task, sizes = model.task, (model.policy.memory_size, model.nominal.memory_size)
        measure, output, policy, nominal, bias = (part.kernel for part in parts)
        rows = 0 if disturbance is None else task.horizon + 1
        noise = np.zeros((1, rows, len(task.inputs) + len(task.states)))
        if disturbance is not None:
            noise[0, :-1, : len(task.inputs)] = disturbance.inputs
            noise[0, :, len(task.inputs) :] = disturbance.sensors
        nominal = Kernel(nominal.function, nominal.parameters[None])
        return CompiledSimulator(
            task, measure, output, policy, *sizes, nominal, bias, noise, (model.nominal,)
        )

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
            and self.policy == other.policy
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
            made = self._run(None, 0, thetas[some], starts[some], None if worlds is None else worlds[some])
            each = zip(made.states, made.inputs, made.frames.tolist(), made.violated.tolist(), strict=True)
            rollouts += [record(task.criteria, *one) for one in each]
        return rollouts

    def costs(
        self, cost: Cost, thetas: Array, starts: Array, worlds: Indices | None = None
    ) -> tuple[Array, Indices]:
        """Costs and frames (k,) of these rollouts; nothing is recorded if the cost has a kernel."""
        if cost.kernel is None:
            return costs_of(cost, self.rollouts(thetas, starts, worlds))
        made = self._run(cost.kernel, cost.totals, thetas, starts, worlds)
        lost = np.where(made.violated < 0, 0, self.task.horizon - made.frames)
        return cost.of_totals(made.totals, lost), made.frames

    def _run(
        self, total: Kernel | None, totals: int, thetas: Array, starts: Array, worlds: Indices | None
    ) -> _Made:
        """Rollouts that a cost's kernel sums up as so many totals or, if there is none, are recorded."""
        task, k = self.task, len(thetas)
        n, m = len(task.states), len(task.inputs)
        policy = self.policy(np.asarray(thetas, dtype=np.float64))
        recorded = 0 if total else k
        made = _Made(
            np.empty((recorded, task.horizon + 1, n)),
            np.empty((recorded, task.horizon, m)),
            np.empty((k, totals)),
            np.empty(k, np.int64),
            np.empty(k, np.int64),
        )
        if not total:
            made.states[:, 0] = starts
        loop = compiled_loop(self._composition(policy, total, totals))
        noise = self.noise.reshape(-1, m + n)
        weights = total.parameters if total else np.empty(0)
        each = (
            np.ascontiguousarray(policy.parameters),
            np.zeros(k, np.int64) if worlds is None else worlds,
            np.ascontiguousarray(starts, dtype=np.float64),
        )

        def run(begin: int, end: int) -> None:
            rows = slice(begin, end)
            own, world, start = (array[rows] for array in each)
            loop(
                task.horizon, task.time_step, _limits(task),
                self.measure.parameters, self.output.parameters, own, self.nominal.parameters,
                self.bias.parameters, weights, noise,
                world, start, *(array[rows] for array in made.arrays),
            )  # fmt: skip

        in_threads(run, k)
        return made

    def _composition(self, policy: Kernel, total: Kernel | None, totals: int) -> Composition:
        """What is compiled."""
        task, bias = self.task, self.bias
        return Composition(
            measure=self.measure.function,
            output=self.output.function,
            control=policy.function,
            step=self.nominal.function,
            correct=bias.function,
            total=total.function if total else None,
            states=len(task.states),
            inputs=len(task.inputs),
            criteria=len(task.criteria),
            totals=totals,
            memory=self.memory,
            hidden=self.hidden,
            measure_parameters=len(self.measure.parameters),
            output_parameters=len(self.output.parameters),
            policy_parameters=policy.parameters.shape[1],
            nominal_parameters=self.nominal.parameters.shape[1],
            bias_parameters=0 if isinstance(bias.parameters, tuple) else len(bias.parameters),
            cost_parameters=len(total.parameters) if total else 0,
            noisy=self.noise.shape[1] > 0,
        )


@dataclass(frozen=True, eq=False)
class _Made:
    """What became of k rollouts."""

    states: Array  # (k, T+1, n), or nothing where a cost was summed up
    inputs: Array  # (k, T, m), likewise
    totals: Array  # (k, s) of the cost
    frames: Indices  # (k,)
    violated: Indices  # (k,) criterion that ended it, -1 at the horizon

    @property
    def arrays(self) -> tuple[Any, ...]:
        """In the order of the loop's arguments."""
        return self.states, self.inputs, self.totals, self.frames, self.violated


def _limits(task: Task) -> Array:
    """Limits (c,) of the criteria."""
    return np.array([criterion.limit for criterion in task.criteria])
