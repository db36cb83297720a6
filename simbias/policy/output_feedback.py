"""The output-feedback policy (Eq. 9, 10)."""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat

from simbias.interfaces import Kernel, Policy, Task
from simbias.records import Array
from simbias.simulation.kernels import CONTROL, kernel


@kernel(CONTROL)
def _control(z, limits_and_gains, u):
    """u = H z (Eq. 9) within the limits (m,), which H (m, q) follows row by row."""
    m, q = u.size, z.size
    for i in range(m):
        limit, torque = limits_and_gains[i], 0.0
        for j in range(q):
            torque += limits_and_gains[m + i * q + j] * z[j]
        u[i] = min(max(torque, -limit), limit)


class OutputFeedback(Policy):
    """u = H z (Eq. 9), its gains searched as h-hat (Eq. 10) within +-`bound` (Table I)."""

    def __init__(self, task: Task, bound: PositiveFloat = 10.0) -> None:
        self._task = task
        self.n_parameters = len(task.inputs) * len(task.outputs)
        self.bounds = (np.full(self.n_parameters, -bound), np.full(self.n_parameters, bound))
        self.kernel = self._compiled

    def gains(self, theta: Array) -> Array:
        """Gain matrix H (m, q) of the parameters h-hat (m q,) (Eq. 10)."""
        h = np.sign(theta) * np.expm1(np.abs(theta))
        return h.reshape(len(self._task.inputs), -1)

    def act(self, theta: Array, x: Array) -> Array:
        """Input u (m,) at the state x (n,) (Eq. 9)."""
        limit = self._task.input_limit
        return np.clip(self.gains(theta) @ self.outputs(x), -limit, limit)

    def outputs(self, x: Array) -> Array:
        """Outputs z (q,) at the state x (n,)."""
        return self._task.output(x)

    def _compiled(self, theta: Array) -> Kernel:
        """The policy with its gains computed once."""
        return Kernel(_control, np.concatenate([self._task.input_limit, self.gains(theta).ravel()]))
