"""Compiled closed-loop rollouts (Eq. 7, 9), sixteen in lockstep on each thread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from simbias.core import Cost, Kernel, Model
from simbias.core.records import Array, Disturbance, Indices, Rollout
from simbias.simulation.compiler import (
    Function,
    LoopKernels,
    PolicyKernel,
    compile_closed_loop,
    in_threads,
    of_cost,
    parts_of,
)
from simbias.simulation.numpy_loop import MOST, costs_of, record, shaped


@dataclass(frozen=True, eq=False)
class CompiledSimulator:
    """The closed loop of components with kernels, hand-written or traced, in one or several scenarios."""

    models: tuple[Model, ...]  # one per scenario; kept, as kernels may hold addresses of their data
    measure: Kernel
    policy: PolicyKernel
    nominal: Kernel  # with its parameters (w, .) in each scenario
    bias: Kernel
    noise: Array  # (w, T+1, m+n) on the inputs and on the sensors; (w, 0, m+n) without noise
    cost: Cost | None = None  # also accumulated for recorded rollouts, so that one loop serves both

    @staticmethod
    def of(
        model: Model, disturbance: Disturbance | None, cost: Cost | None = None
    ) -> CompiledSimulator | None:
        """The model's closed loop; None if a part has no kernel and cannot be traced."""
        parts = parts_of(model)
        if any(part.kernel is None for part in parts):
            return None
        task = model.task
        measure, policy, nominal, bias = (part.kernel for part in parts)
        rows = 0 if disturbance is None else task.horizon + 1
        noise = np.zeros((1, rows, len(task.inputs) + len(task.states)))
        if disturbance is not None:
            noise[0, :-1, : len(task.inputs)] = disturbance.inputs
            noise[0, :, len(task.inputs) :] = disturbance.sensors
        nominal = Kernel(nominal.function, nominal.parameters[None])
        return CompiledSimulator((model,), measure, policy, nominal, bias, noise, cost)

    @staticmethod
    def join(simulators: Sequence[CompiledSimulator]) -> CompiledSimulator | None:
        """Simulators in lockstep; None if they differ in more than the nominal parameters and the noise."""
        first = simulators[0]
        if not all(map(first._runs_in_lockstep_with, simulators)):
            return None
        parameters = np.concatenate([simulator.nominal.parameters for simulator in simulators])
        return replace(
            first,
            nominal=Kernel(first.nominal.function, parameters),
            noise=np.concatenate([simulator.noise for simulator in simulators]),
            models=tuple(model for simulator in simulators for model in simulator.models),
        )

    def _runs_in_lockstep_with(self, other: CompiledSimulator) -> bool:
        """Whether the scenarios differ only in the values of nominal parameters and noise."""
        model, others = self.models[0], other.models[0]
        return (
            model.task is others.task
            and self.policy is other.policy
            and self.bias.function is other.bias.function
            and self.bias.parameters is other.bias.parameters
            and self.nominal.function is other.nominal.function
            and model.nominal.state_size == others.nominal.state_size
            and model.nominal.acting == others.nominal.acting
            and self.nominal.parameters.shape[1:] == other.nominal.parameters.shape[1:]
            and self.noise.shape[1:] == other.noise.shape[1:]
        )

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon, in the first scenario."""
        return self.rollouts(theta[None], start[None])[0]

    def rollouts(self, thetas: Array, starts: Array, scenarios: Indices | None = None) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its scenario of (k,), on all threads."""
        criteria, rollouts = self.models[0].task.criteria, []
        for first in range(0, len(thetas), MOST):
            some = slice(first, first + MOST)
            own = None if scenarios is None else scenarios[some]
            batch = self._run(self.cost, True, thetas[some], starts[some], own)
            ends = batch.frames.tolist(), batch.violated.tolist()
            each = zip(batch.states, batch.inputs, *ends, strict=True)
            rollouts += [record(criteria, *one) for one in each]
        return rollouts

    def costs(
        self, cost: Cost, thetas: Array, starts: Array, scenarios: Indices | None = None
    ) -> tuple[Array, Indices]:
        """Costs and frames (k,) of these rollouts; nothing is recorded if the cost's terms can be traced."""
        task = self.models[0].task
        if of_cost(cost, task).kernel is None:
            return costs_of(cost, self.rollouts(thetas, starts, scenarios))
        batch = self._run(cost, False, thetas, starts, scenarios)
        lost = np.where(batch.violated < 0, 0, task.horizon - batch.frames)
        return cost.of_totals(batch.totals, lost), batch.frames

    def _run(
        self, cost: Cost | None, recorded: bool, thetas: Array, starts: Array, scenarios: Indices | None
    ) -> RolloutBatch:
        """Run rollouts, recorded or not; the cost's terms are accumulated if they can be traced."""
        k, task = len(thetas), self.models[0].task
        starts = shaped("starts", starts, k, len(task.states))
        rows = k if recorded else 0
        batch = RolloutBatch(
            np.empty((rows, task.horizon + 1, len(task.states))),
            np.empty((rows, task.horizon, len(task.inputs))),
            np.zeros((k, len(cost.reductions) if cost else 0)),
            np.full(k, -1),
            np.full(k, -1),
        )
        if recorded:
            batch.states[:, 0] = starts
        terms = of_cost(cost, task).kernel if cost else None
        loop = partial(
            compile_closed_loop(self._composition(terms, cost)),
            *(task.horizon, task.time_step, np.array([criterion.limit for criterion in task.criteria])),
            *(self.measure.parameters, self.policy.constants),
            self.policy.parameters(np.asarray(thetas, dtype=np.float64)),
            *(self.nominal.parameters, self.bias.parameters, terms.parameters if terms else np.empty(0)),
            self.noise.reshape(-1, len(task.inputs) + len(task.states)),
            np.zeros(k, np.int64) if scenarios is None else scenarios,
            *(starts, batch.states, batch.inputs, batch.totals, batch.frames, batch.violated),
        )
        in_threads(loop, k)
        return batch

    def _composition(self, terms: Kernel | None, cost: Cost | None) -> LoopKernels:
        """The functions and sizes from which the closed loop is compiled."""
        model, policy = self.models[0], self.policy
        return LoopKernels(
            measure=Function.of(self.measure),
            control=Function(policy.function, len(policy.constants)),
            step=Function.of(self.nominal),
            correct=Function.of(self.bias),
            terms=Function.of(terms) if terms else None,
            n=len(model.task.states),
            m=len(model.task.inputs),
            criteria=len(model.task.criteria),
            policy_parameters=policy.size,
            columns=policy.columns,
            n_policy_state=model.policy.state_size,
            n_model_state=model.nominal.state_size,
            reductions=cost.reductions if cost and terms else (),
            noisy=self.noise.shape[1] > 0,
            acting=model.nominal.acting,
            targets=len(model.task.targets),
        )


@dataclass(frozen=True, eq=False)
class RolloutBatch:
    """Records and costs of k rollouts, filled by the loop."""

    states: Array  # (k, T+1, n), or empty if not recorded
    inputs: Array  # (k, T, m), or empty if not recorded
    totals: Array  # (k, s) of the cost's terms
    frames: Indices  # (k,)
    violated: Indices  # (k,) criterion that ended it, -1 at the horizon
