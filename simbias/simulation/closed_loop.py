"""Closed-loop rollouts in simulation (Eq. 7, 9): compiled and many at once, or in plain Python."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
from numba import get_num_threads, int64, njit, typeof, types, void

from simbias.interfaces import FittedBias, Kernel, Nominal, Policy, Simulator, Task
from simbias.records import Array, Disturbance, Indices, Rollout
from simbias.simulation.kernels import (
    CONTROL,
    CUBE,
    MATRIX,
    MEASURE,
    OUTPUT,
    STEP,
    VECTOR,
    correction_signature,
)
from simbias.simulation.lanes import WIDTH

_NOMINAL = 2  # of a simulator's kernels


@dataclass(frozen=True, eq=False)
class Model:
    """The corrected simulation model of Eq. 7, and the task and policy that close its loop."""

    task: Task
    policy: Policy
    nominal: Nominal
    bias: FittedBias

    def simulator(self, disturbance: Disturbance | None = None) -> Simulator:
        """The compiled closed loop where every part of it has a kernel, the plain one otherwise."""
        task, policy = self.task, self.policy
        parts = (task.measure_kernel, task.output_kernel, self.nominal.kernel, self.bias.kernel)
        kernels = tuple(part for part in parts if part is not None)
        if len(kernels) < len(parts) or policy.kernel is None:
            return PlainSimulator(self, disturbance)
        noise = disturbance or Disturbance(np.empty((0, 0)), np.empty((0, 0)))
        nominal = kernels[_NOMINAL].parameters
        return CompiledSimulator(
            task, kernels, policy.kernel, nominal[None], noise.inputs[None], noise.sensors[None]
        )


class Worlds(Protocol):
    """Simulators of one task that are run together."""

    def rollouts(self, thetas: Array, starts: Array, worlds: Indices) -> Sequence[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its world of (k,)."""


def joined(simulators: Sequence[Simulator]) -> Worlds:
    """Simulators as one: in step, if they share all but the nominal model's parameters and the noise."""
    compiled = [simulator for simulator in simulators if isinstance(simulator, CompiledSimulator)]
    first = compiled[0] if compiled else None
    if first is None or len(compiled) < len(simulators) or not all(map(first.runs_in_step_with, compiled)):
        return Apart(simulators)
    return replace(
        first,
        nominal_data=np.concatenate([simulator.nominal_data for simulator in compiled]),
        input_noise=np.concatenate([simulator.input_noise for simulator in compiled]),
        sensor_noise=np.concatenate([simulator.sensor_noise for simulator in compiled]),
    )


@dataclass(frozen=True, eq=False)
class Apart:
    """Simulators that have to be run one after the other."""

    simulators: Sequence[Simulator]

    def rollouts(self, thetas: Array, starts: Array, worlds: Indices) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n) in its world of (k,)."""
        found: dict[int, Rollout] = {}
        for world, simulator in enumerate(self.simulators):
            own = np.flatnonzero(worlds == world)
            found |= zip(own.tolist(), simulator.rollouts(thetas[own], starts[own]), strict=True)
        return [found[index] for index in range(len(thetas))]


@dataclass(frozen=True, eq=False)
class PlainSimulator:
    """The closed loop in Python: slow, for components without kernels; the reference of the compiled one."""

    model: Model
    disturbance: Disturbance | None = None

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon."""
        model, task, noise = self.model, self.model.task, self.disturbance
        states = [np.array(start, dtype=np.float64)]
        inputs = np.empty((task.horizon, len(task.inputs)))
        violated = task.violated(states[0])
        t = 0
        while violated is None and t < task.horizon:
            x = states[t]
            inputs[t] = model.policy.act(theta, x if noise is None else x + noise.sensors[t])
            u = inputs[t] if noise is None else inputs[t] + noise.inputs[t]
            states.append(model.nominal.step(x, u) + model.bias.correction(x, u))
            violated = task.violated(states[-1])
            t += 1
        return _record(task, np.array(states), inputs[:t], violated)

    def rollouts(self, thetas: Array, starts: Array) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n)."""
        return [self.rollout(theta, start) for theta, start in zip(thetas, starts, strict=True)]


@dataclass(frozen=True, eq=False)
class CompiledSimulator:
    """The closed loop without Python in it, in one world or in several."""

    task: Task
    kernels: tuple[Kernel, ...]  # of measure, output, nominal model and bias
    policy: Callable[[Array], Kernel]
    nominal_data: Array  # (w, q) the nominal kernel's parameters in each world
    input_noise: Array  # (w, T, m); empty without noise
    sensor_noise: Array  # (w, T, n); likewise

    def runs_in_step_with(self, other: CompiledSimulator) -> bool:
        """Whether their worlds differ in nothing but the nominal parameters' values and the noise's."""
        same = all(
            one.function is another.function and (index == _NOMINAL or one.parameters is another.parameters)
            for index, (one, another) in enumerate(zip(self.kernels, other.kernels, strict=True))
        )
        shapes = [(s.nominal_data[0].shape, s.sensor_noise[0].shape) for s in (self, other)]
        own = self.task is other.task and self.policy == other.policy
        return same and own and shapes[0] == shapes[1]

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon."""
        return self._in_step(theta[None], start[None], np.zeros(1, np.int64))[0]

    def rollouts(self, thetas: Array, starts: Array, worlds: Indices | None = None) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n), on all threads if they are many.

        Each runs in its world of (k,); None is the first for all.
        """
        k = len(thetas)
        if k == 0:
            return []
        worlds = np.zeros(k, np.int64) if worlds is None else worlds
        threads = min(get_num_threads(), math.ceil(k / WIDTH))
        if threads < 2:  # what a thread frees stays with it: and is not given back
            return self._in_step(thetas, starts, worlds)
        parts = (np.array_split(each, threads) for each in (thetas, starts, worlds))
        with ThreadPoolExecutor(threads) as pool:
            return [rollout for part in pool.map(self._in_step, *parts) for rollout in part]

    def _in_step(self, thetas: Array, starts: Array, worlds: Indices) -> list[Rollout]:
        """Rollouts of which up to WIDTH run in step."""
        task, k = self.task, len(thetas)
        policies = [self.policy(np.asarray(theta, dtype=np.float64)) for theta in thetas]
        functions, (task_data, output_data, _, bias_data) = zip(*self.kernels, strict=True)
        states = np.empty((k, task.horizon + 1, len(task.states)))
        states[:, 0] = starts
        inputs = np.empty((k, task.horizon, len(task.inputs)))
        frames, violated = np.empty(k, np.int64), np.empty(k, np.int64)
        _compile(typeof(bias_data))(
            policies[0].function,
            *functions,
            np.array([policy.parameters for policy in policies]),
            task_data,
            output_data,
            self.nominal_data,
            bias_data,
            np.array([criterion.limit for criterion in task.criteria]),
            np.empty(len(task.outputs)),
            worlds,
            self.input_noise,
            self.sensor_noise,
            states,
            inputs,
            frames,
            violated,
        )
        return [
            _record(task, states[b, : t + 1], inputs[b, :t], criterion if criterion >= 0 else None)
            for b, (t, criterion) in enumerate(zip(frames.tolist(), violated.tolist(), strict=True))
        ]


def _record(task: Task, states: Array, inputs: Array, violated: int | None) -> Rollout:
    """The record of a rollout that ended with its last state."""
    if violated is None:
        return Rollout(states, inputs)
    return Rollout(states, inputs, failed_at=len(inputs), failure=task.criteria[violated].words)


@cache
def _compile(bias_data: Any) -> Any:
    """The closed loop for one type of bias data."""
    roles = (CONTROL, MEASURE, OUTPUT, STEP, correction_signature(bias_data))
    functions = (types.FunctionType(role) for role in roles)
    parameters = (MATRIX, VECTOR, VECTOR, MATRIX, bias_data, VECTOR, VECTOR)
    signature = void(*functions, *parameters, int64[::1], *[CUBE] * 4, int64[::1], int64[::1])
    return njit(signature, cache=True, nogil=True)(_closed_loop)


def _closed_loop(
    control, measure, output, step, correct,
    policy_data, task_data, output_data, nominal_data, bias_data,
    limits, z, worlds, input_noise, sensor_noise, states, inputs, frames, violated,
):  # fmt: skip
    """Fill states (k, T+1, n) and inputs (k, T, m), frames (k,), and the criterion that ended each rollout.

    The criterion is -1 at the horizon. A rollout that ends makes room for the next, so that as many as
    possible run in step. What is called gets small arrays of its own: a view of a large one costs more than
    copying six numbers.
    """
    k, horizon = states.shape[0], inputs.shape[1]
    n, m = states.shape[2], inputs.shape[2]
    noisy = sensor_noise.size > 0
    running, count, begun = np.empty(min(k, WIDTH), np.int64), 0, 0
    measures = np.empty(limits.size)
    x, seen, u, x_next = np.empty(n), np.empty(n), np.empty(m), np.empty(n)
    all_x, all_u = np.empty((running.size, n)), np.empty((running.size, m))
    correction = np.empty((running.size, n))
    frames[:] = 0
    while count > 0 or begun < k:
        while count < running.size and begun < k:
            running[count] = begun
            count += 1
            begun += 1
        going = 0
        for b in running[:count]:
            t, w = frames[b], worlds[b]
            for i in range(n):
                x[i] = states[b, t, i]
            measure(x, task_data, measures)
            criterion = -1
            for i in range(limits.size - 1, -1, -1):
                if not measures[i] <= limits[i]:  # so that nan fails
                    criterion = i
            if criterion >= 0 or t == horizon:
                violated[b] = criterion
                continue
            for i in range(n):
                seen[i] = x[i] + sensor_noise[w, t, i] if noisy else x[i]
            output(seen, output_data, z)
            control(z, policy_data[b], u)
            for i in range(m):
                inputs[b, t, i] = u[i]
                u[i] += input_noise[w, t, i] if noisy else 0.0
                all_u[going, i] = u[i]
            step(x, u, nominal_data[w], x_next)
            for i in range(n):
                all_x[going, i] = x[i]
                states[b, t + 1, i] = x_next[i]
            running[going] = b
            going += 1
        count = going
        if count > 0:
            correct(all_x[:count], all_u[:count], bias_data, correction[:count])
        for a in range(count):
            b = running[a]
            frames[b] += 1
            for i in range(n):
                states[b, frames[b], i] += correction[a, i]
