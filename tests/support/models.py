"""Models with other values of their parameters, and what they do under inputs."""

from typing import Any

import numpy as np

from simbias.core import Nominal, Task
from simbias.core.records import Array
from simbias.policy.output_feedback import OutputFeedback


def with_values(model: Any, **values: float) -> Any:
    """The model with these parameters, all else as it was declared."""
    known = {parameter.name: parameter.value for parameter in model.parameters}
    assert values.keys() <= known.keys()
    return model.with_parameters(np.array(list((known | values).values())))


def driven(model: Nominal, start: Array, inputs: Array) -> Array:
    """Its states (k + 1, n) under inputs (k, m)."""
    states, memory = [start], np.zeros(model.state_size)
    for u in inputs:
        x, memory = model.advance(states[-1], u, memory)
        states.append(x)
    return np.array(states)


class Sliding(OutputFeedback):
    """Output feedback of the state that a temporary model predicts."""

    def __init__(self, task: Task, nominal: Nominal) -> None:
        super().__init__(task)
        self.nominal = nominal

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        ahead = self.nominal.without_dry_friction().step(x, 0.0 * x[..., :1])
        return super().act(theta, ahead, t, policy_state)
