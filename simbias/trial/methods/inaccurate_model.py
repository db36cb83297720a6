"""Policy gradient from an inaccurate model, cost from the hardware."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from simbias.core.model import Model
from simbias.core.ranges import Count, Deviation
from simbias.core.records import Array, Iteration, Rollout
from simbias.simulation.numpy_loop import record
from simbias.trial.method import Method
from simbias.trial.observer import Observer
from simbias.trial.steps import Stopwatch, experiment, iteration_record, log_costs, search
from simbias.trial.study import Study

NEAR = 1e-3  # of the box's width: half the step of central differences


@dataclass(eq=False)
class InaccurateModel(Method):
    """Improve a policy along the gradient of a model that is made exact along the last experiment.

    Abbeel, Quigley and Ng (ICML 2006): the model's error in each frame of the experiment is added to its
    step, so that it reproduces the experiment. The gradient of the cost with respect to the policy's
    parameters is taken there. The step size is tested on hardware: a step that does not reduce the cost is
    halved. The first policy is searched on the model.

    Parameters
    ----------
    step
        First step along the gradient of ln Z, in units of the box's width.
    max_iterations
        The maximum number of policies tried.
    experiments
        Hardware experiments per iteration; the first failure ends them.
    """

    step: Deviation = 0.02
    max_iterations: Count = 10
    experiments: Count = 2

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Yield a record of every policy that is tried."""
        search_rng, hardware_rng = rng.spawn(2)
        clock, model, found = Stopwatch(), study.first_model(), None
        width = np.subtract(*study.policy.bounds[::-1])
        with clock("search"):
            found = search(study, model, search_rng, observer)
        theta, made = found.optimum.parameters, 0
        best, least, direction, step = theta, np.inf, np.zeros_like(theta), self.step
        for index in range(self.max_iterations):
            with clock("experiments"):
                rollouts = experiment(study, model, theta, hardware_rng, observer, self.experiments, 1)
            made += len(rollouts)
            tried = iteration_record(study, index, theta, rollouts, made, clock, model, found)
            yield tried
            if tried.succeeded:
                return
            clock, found = Stopwatch(), None
            with clock("search"):
                if tried.hardware_cost < least:
                    best, least, step = theta, tried.hardware_cost, self.step
                    worst = max(rollouts, key=lambda rollout: rollout.cost)
                    direction = -gradient(study, model, theta, worst)
                else:
                    step /= 2
                theta = np.clip(best + step * width * direction, *study.policy.bounds)


def gradient(study: Study, model: Model, theta: Array, experiment: Rollout) -> Array:
    """The direction (p,), of unit length in the box, in which ln Z grows fastest; zero where it is flat."""
    lower, upper = study.policy.bounds
    steps = NEAR * np.diag(upper - lower)
    both = np.concatenate([theta + steps, theta - steps])
    costs = log_costs([study.cost.of(rollout) for rollout in along(model, both, experiment)])
    slopes = np.subtract(*np.split(costs, 2))
    return slopes / (np.linalg.norm(slopes) or 1.0)


def along(model: Model, thetas: Array, experiment: Rollout) -> list[Rollout]:
    """Rollouts of thetas (k, p) from an experiment's start, on the model made exact along it."""
    task, nominal, policy, k = model.task, model.nominal, model.policy, len(thetas)
    n = len(task.without_targets.states)  # targets, which follow, stay constant
    recorded = experiment.of_states(n)
    missed = recorded.states[1:] - nominal.along(recorded.states[:-1], recorded.inputs)
    states = np.empty((k, task.horizon + 1, len(task.states)))
    inputs = np.empty((k, task.horizon, len(task.inputs)))
    states[:], frames, violated = experiment.states[0], np.full(k, task.horizon), np.full(k, -1)
    policy_state, model_state = np.zeros((k, policy.state_size)), np.zeros((k, nominal.state_size))
    for t in range(task.horizon + 1):
        failing = task.violated(states[:, t])
        new = (failing >= 0) & (violated < 0)
        frames[new], violated[new] = t, failing[new]
        if t == task.horizon or (violated >= 0).all():
            break
        inputs[:, t], policy_state = policy.act(thetas, states[:, t], t * task.time_step, policy_state)
        following, model_state = nominal.advance(states[:, t, :n], inputs[:, t], model_state)
        states[:, t + 1, :n] = following + (missed[t] if t < len(missed) else 0.0)
        states[violated >= 0, t + 1] = states[violated >= 0, t]  # freeze failed rollouts: no overflow
    ends = zip(frames.tolist(), violated.tolist(), strict=True)
    return [record(task.criteria, x, u, *end) for x, u, end in zip(states, inputs, ends, strict=True)]
