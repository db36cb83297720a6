"""Closed-loop rollouts in simulation (Eq. 7, 9): compiled and many at once, or in plain Python."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import get_num_threads, int64, njit, typeof, types, void

from simbias.interfaces import FittedBias, Kernel, Nominal, Policy, Simulator, Task
from simbias.kernels import CONTROL, CUBE, MATRIX, MEASURE, OUTPUT, STEP, VECTOR, correction_signature
from simbias.lanes import WIDTH
from simbias.records import Array, Disturbance, Rollout


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
        return CompiledSimulator(task, kernels, policy.kernel, disturbance)


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
    """The closed loop without Python in it."""

    task: Task
    kernels: tuple[Kernel, ...]  # of measure, output, nominal model and bias
    policy: Callable[[Array], Kernel]
    disturbance: Disturbance | None = None

    def rollout(self, theta: Array, start: Array) -> Rollout:
        """Run theta (p,) from start (n,) to failure or horizon."""
        return self._in_step([theta], [start])[0]

    def rollouts(self, thetas: Array, starts: Array) -> list[Rollout]:
        """Run each theta of (k, p) from its start of (k, n), on all threads if they are many."""
        if len(thetas) == 0:
            return []
        threads = min(get_num_threads(), math.ceil(len(thetas) / WIDTH))
        if threads < 2:  # what a thread frees stays with it: and is not given back
            return self._in_step(thetas, starts)
        parts = np.array_split(thetas, threads), np.array_split(starts, threads)
        with ThreadPoolExecutor(threads) as pool:
            return [rollout for part in pool.map(self._in_step, *parts) for rollout in part]

    def _in_step(self, thetas: Sequence[Array] | Array, starts: Sequence[Array] | Array) -> list[Rollout]:
        """Rollouts of which up to WIDTH run in step."""
        task, k = self.task, len(thetas)
        policies = [self.policy(np.asarray(theta, dtype=np.float64)) for theta in thetas]
        functions, parameters = zip(*self.kernels, strict=True)
        noise = self.disturbance or Disturbance(np.empty((0, 0)), np.empty((0, 0)))
        states = np.empty((k, task.horizon + 1, len(task.states)))
        states[:, 0] = starts
        inputs = np.empty((k, task.horizon, len(task.inputs)))
        frames, violated = np.empty(k, np.int64), np.empty(k, np.int64)
        _compile(typeof(parameters[-1]))(
            policies[0].function,
            *functions,
            np.array([policy.parameters for policy in policies]),
            *parameters,
            np.array([criterion.limit for criterion in task.criteria]),
            np.empty(len(task.outputs)),
            noise.inputs,
            noise.sensors,
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
    parameters = (MATRIX, VECTOR, VECTOR, VECTOR, bias_data, VECTOR, VECTOR)
    signature = void(*functions, *parameters, MATRIX, MATRIX, CUBE, CUBE, int64[::1], int64[::1])
    return njit(signature, cache=True, nogil=True)(_closed_loop)


def _closed_loop(
    control, measure, output, step, correct,
    policy_data, task_data, output_data, nominal_data, bias_data,
    limits, z, input_noise, sensor_noise, states, inputs, frames, violated,
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
            t = frames[b]
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
                seen[i] = x[i] + sensor_noise[t, i] if noisy else x[i]
            output(seen, output_data, z)
            control(z, policy_data[b], u)
            for i in range(m):
                inputs[b, t, i] = u[i]
                u[i] += input_noise[t, i] if noisy else 0.0
                all_u[going, i] = u[i]
            step(x, u, nominal_data, x_next)
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
