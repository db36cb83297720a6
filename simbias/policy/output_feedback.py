"""The output-feedback policy (Eq. 9, 10)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, final

import numpy as np
from pydantic import Field

from simbias.core import Controller, Kernel, Law, Policy, Task
from simbias.core.records import Array
from simbias.policy.gains import inverse_signed_exponential, least_squares_gains, signed_exponential


def _law(inputs: int, first: int = 0) -> Callable:
    """The kernel for so many inputs; parameters: lower and upper limits (m,), then H (m, q) row by row."""
    if first == inputs:
        return lambda z, limits_and_gains: ()
    others = _law(inputs, first + 1)

    def control(z, limits_and_gains):
        """u = H z (Eq. 9), from the first of them on."""
        least, most, u = limits_and_gains[first], limits_and_gains[inputs + first], 0.0
        for j in range(len(z)):
            u += limits_and_gains[2 * inputs + first * len(z) + j] * z[j]
        return (min(max(u, least), most),) + others(z, limits_and_gains)  # noqa: RUF005 (for Numba)

    return control


@final
class OutputFeedback(Policy):
    """u = H z (Eq. 9), its gains searched as h-hat (Eq. 10) within +-`bound` (Table I)."""

    def __init__(self, task: Task, bound: Annotated[float, Field(gt=0, le=100)] = 10.0) -> None:
        self._task = task
        self.n_parameters = len(task.inputs) * len(task.outputs)
        self.bounds = (np.full(self.n_parameters, -bound), np.full(self.n_parameters, bound))
        self._control = _law(len(task.inputs))
        self.kernel = self._compiled

    def gains(self, theta: Array) -> Array:
        """Gain matrices H (..., m, q) of the parameters h-hat (..., m q) (Eq. 10)."""
        h = signed_exponential(theta)
        return h.reshape(*h.shape[:-1], len(self._task.inputs), len(self._task.outputs))

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n) (Eq. 9)."""
        u = (self.gains(theta) @ self.outputs(x)[..., None])[..., 0]
        return np.clip(u, *self._task.input_bounds), memory

    def controller(self, theta: Array, time_step: float) -> Controller:
        """The law with its gains computed once."""
        return _Loop(self, theta, *self._task.input_bounds)

    def law(self, theta: Array) -> Law:
        """Eq. 9, its gains in the task's units: a row for each input, a column for each output."""
        return Law(
            "u = H z, cut off at the inputs' limits; rows of H: inputs, columns: outputs",
            {"H": self.gains(theta)},
        )

    def outputs(self, x: Array) -> Array:
        """Outputs z (..., q) at states x (..., n)."""
        return self._task.output(x)

    def imitating(self, states: Array, inputs: Array) -> Array:
        """The parameters (p,) that come nearest to these inputs (k, T, m) at these states (k, T, n)."""
        z = self.outputs(states)
        H = [least_squares_gains(z, inputs[..., i]) for i in range(inputs.shape[-1])]
        return np.clip(inverse_signed_exponential(np.concatenate(H)), *self.bounds)

    def _compiled(self, thetas: Array) -> Kernel:
        """The policies (k, p) with their gains computed once: parameters (k, 2 m + m q)."""
        gains = self.gains(thetas).reshape(len(thetas), self.n_parameters)
        limits = np.tile(np.concatenate(self._task.input_bounds), (len(thetas), 1))
        return Kernel(self._control, np.concatenate([limits, gains], axis=1))


class _Loop(Controller):
    """u = H z (Eq. 9), frame by frame."""

    def __init__(self, policy: OutputFeedback, theta: Array, least: Array, most: Array) -> None:
        self._outputs = policy.outputs
        self._gains = policy.gains(theta)
        self._least, self._most = least, most

    def __call__(self, x: Array) -> Array:
        """Input u (m,) at the state x (n,)."""
        u = self._gains.dot(self._outputs(x))  # of so few numbers in half of the time that @ takes
        return np.minimum(np.maximum(u, self._least), self._most)
