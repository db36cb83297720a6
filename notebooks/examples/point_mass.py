"""A robot of one's own, in plain Python without kernels: a point mass to be held near the origin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simbias.core import Cost, Criterion, Hardware, Nominal, Policy, Quantity, Samples, Task
from simbias.core.records import Array, Rollout, Selection, Transitions


class PointMass(Task):
    states = (Quantity("position", "m"), Quantity("velocity", "m/s"))
    inputs = (Quantity("force", "N"),)
    outputs = states
    criteria = (Criterion("distance", "too far from the origin", 1.0, "m"),)
    start_deviation = np.array([0.01, 0.01])
    input_limit = np.array([5.0])

    def __init__(self, time_step: float = 0.02, horizon: int = 100) -> None:
        self.time_step = time_step
        self.horizon = horizon
        self.start_mean = np.array([0.5, 0.0])

    def measure(self, x: Array) -> Array:
        return np.abs(x[..., :1])

    def output(self, x: Array) -> Array:
        return x.copy()


class WithoutWind(Nominal):
    def __init__(self, task: PointMass, mass: float = 1.0) -> None:
        self._dt, self._mass = task.time_step, mass

    def step(self, x: Array, u: Array) -> Array:
        velocity = x[..., 1] + self._dt * u[..., 0] / self._mass
        return np.stack([x[..., 0] + self._dt * velocity, velocity], axis=-1)


class InTheWind(Hardware):
    """The same mass in a constant wind: what there is to learn."""

    def __init__(self, task: PointMass, wind: float = 2.0) -> None:
        self._task, self._wind, self._still = task, wind, WithoutWind(task)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        states, inputs, failure = [start], [], self._task.failure(start)
        controller = policy.controller(theta, self._task.time_step)
        while failure is None and len(inputs) < self._task.horizon:
            inputs.append(controller(states[-1]))
            states.append(self._still.step(states[-1], inputs[-1] + self._wind))
            failure = self._task.failure(states[-1])
        return Rollout(
            states=np.array(states),
            inputs=np.array(inputs).reshape(-1, 1),
            failed_at=None if failure is None else len(inputs),
            failure=failure,
        )


class Spring(Policy):
    """A spring, a damper and a constant force."""

    n_parameters = 3
    bounds = (np.array([0.0, 0.0, -4.0]), np.array([10.0, 10.0, 4.0]))

    def __init__(self, task: PointMass) -> None:
        self._limit = task.input_limit

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        force = theta[..., 2:] - np.sum(theta[..., :2] * x, axis=-1, keepdims=True)
        return np.clip(force, -self._limit, self._limit), policy_state


class EveryFifth(Samples):
    def select(self, rollouts: Sequence[Rollout], nominal: Nominal) -> Selection:
        triples = [zip(r.states, r.inputs, r.states[1:], strict=False) for r in rollouts]
        pairs = [triple for rollout in triples for triple in rollout][::5]
        inputs = np.array([np.concatenate([x, u]) for x, u, _ in pairs]).reshape(-1, 3)
        residuals = np.array([y - nominal.step(x, u) for x, u, y in pairs]).reshape(-1, 2)
        return Selection(Transitions(inputs, residuals), sum(r.frames for r in rollouts), len(pairs), {})


class Distance(Cost):
    """The mean distance; a failed run costs 10 more."""

    max_cost = 0.1875  # exact in binary

    def of(self, rollout: Rollout) -> float:
        return float(np.mean(np.abs(rollout.states[:, 0]))) + 10.0 * (rollout.failed_at is not None)
