"""Output feedback with an integral that has its own gains."""

from __future__ import annotations

import numpy as np

from simbias.core import Policy, Task
from simbias.core.ranges import Bound
from simbias.core.records import Array
from simbias.policy.gains import inverse_signed_exponential, least_squares_gains, signed_exponential


class IntegralFeedback(Policy):
    """u = H z + G w within the task's limits, with w the time integral of some outputs.

    H and G are searched as in Eq. 10. A steady disturbance leaves no error in the integrated outputs. The
    integral is held while an input is at its limit.

    Parameters
    ----------
    bound
        |h-hat| <= bound, as in `OutputFeedback`.
    outputs
        Names of the integrated outputs; None: the first one.
    """

    def __init__(self, task: Task, bound: Bound = 10.0, outputs: list[str] | None = None) -> None:
        names = [output.name for output in task.outputs]
        chosen = names[:1] if outputs is None else outputs
        for name in chosen:
            if name not in names:
                raise ValueError(f"outputs: none is called {name}; available: {', '.join(names)}")
        self._task = task
        self._chosen = [names.index(name) for name in chosen]
        self.state_size = len(chosen)
        self.n_parameters = len(task.inputs) * (len(names) + len(chosen))
        self.bounds = np.full(self.n_parameters, -bound), np.full(self.n_parameters, bound)

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n), and the next integral w (..., i)."""
        z = self._task.output(x)
        gains = signed_exponential(theta).reshape(*theta.shape[:-1], len(self._task.inputs), -1)
        asked = (gains @ np.concatenate([z, policy_state], axis=-1)[..., None])[..., 0]
        u = np.clip(asked, *self._task.input_bounds)
        free = np.where(np.abs(u - asked).sum(axis=-1, keepdims=True) > 0, 0.0, 1.0)
        return u, policy_state + self._task.time_step * free * z[..., self._chosen]

    def integrated(self, x: Array) -> Array:
        """The integrated outputs (..., i) at states x (..., n)."""
        return self._task.output(x)[..., self._chosen]

    def imitating(self, states: Array, inputs: Array) -> Array:
        """The parameters (p,) that best imitate these inputs (k, T, m) at these states (k, T, n)."""
        z = self._task.output(states)
        w = self._task.time_step * np.cumsum(z[..., self._chosen], axis=1)
        features = np.concatenate([z, np.pad(w, ((0, 0), (1, 0), (0, 0)))[:, :-1]], axis=-1)
        gains = [least_squares_gains(features, inputs[..., i]) for i in range(inputs.shape[-1])]
        return np.clip(inverse_signed_exponential(np.concatenate(gains)), *self.bounds)
