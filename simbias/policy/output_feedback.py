"""The output-feedback policy (Eq. 9, 10)."""

from __future__ import annotations

from typing import final

import numpy as np

from simbias.core import Law, Policy, Task
from simbias.core.ranges import Bound
from simbias.core.records import Array
from simbias.policy.gains import inverse_signed_exponential, least_squares_gains, signed_exponential


@final
class OutputFeedback(Policy):
    """u = H z (Eq. 9); gains are searched as h-hat (Eq. 10) within +-`bound` (Table I)."""

    def __init__(self, task: Task, bound: Bound = 10.0) -> None:
        self._task = task
        self.n_parameters = len(task.inputs) * len(task.outputs)
        self.bounds = (np.full(self.n_parameters, -bound), np.full(self.n_parameters, bound))

    def gains(self, theta: Array) -> Array:
        """Gain matrices H (..., m, q) from the parameters h-hat (..., m q) (Eq. 10)."""
        h = signed_exponential(theta)
        return h.reshape(*h.shape[:-1], len(self._task.inputs), len(self._task.outputs))

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n) (Eq. 9)."""
        u = (self.gains(theta) @ self._task.output(x)[..., None])[..., 0]
        return np.clip(u, *self._task.input_bounds), policy_state

    def law(self, theta: Array) -> Law:
        """Eq. 9 with gains in the task's units: a row for each input, a column for each output."""
        words = "u = H z, cut off at the inputs' limits; rows of H: inputs, columns: outputs"
        return Law(words, {"H": self.gains(theta)})

    def imitating(self, states: Array, inputs: Array) -> Array:
        """The parameters (p,) that best imitate these inputs (k, T, m) at these states (k, T, n)."""
        z = self._task.output(states)
        H = [least_squares_gains(z, inputs[..., i]) for i in range(inputs.shape[-1])]
        return np.clip(inverse_signed_exponential(np.concatenate(H)), *self.bounds)
