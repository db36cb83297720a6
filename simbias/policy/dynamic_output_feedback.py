"""Dynamic output feedback: with a filter, an integral, the last inputs and a constant."""

from __future__ import annotations

from typing import Annotated, final

import numpy as np
from pydantic import Field

from simbias.core import Policy, Task
from simbias.core.ranges import Bound
from simbias.core.records import Array
from simbias.policy.gains import TINY, inverse_signed_exponential, least_squares_gains, signed_exponential

FilterSeconds = Annotated[float, Field(ge=0, le=10)]
IntegralRate = Annotated[float, Field(ge=0, le=100)]  # 1/s
DelaySeconds = Annotated[float, Field(ge=0, le=1)]
DelayRate = Annotated[float, Field(gt=0, le=1e6)]  # 1/s
Constant = Annotated[float, Field(ge=0, le=100)]


@final
class DynamicOutputFeedback(Policy):
    """u = H (y + rho w) + g s + u_0 within the task's limits, with memory; H as in Eq. 9 and 10.

    y are the outputs z, with rates passed through a low-pass filter of time constant tau; w is the time
    integral of some outputs; s is the integral of the law's own inputs over the last `delay_seconds`. tau,
    rho, g and u_0 are searched with H: four more parameters for one input. A part that is switched off has no
    parameter.

    - The filter keeps sensor noise out of the input, but delays it.
    - The integral removes the steady error due to a constant offset, such as a sloping floor. It is held
      while an input is at its limit.
    - Inputs that were sent but are not yet visible in the measured state predict the future state. If the
      input B u acts after a delay, z + B s is the state at that time, to first order in the delay, and
      g = H B compensates the delay.
    - The constant u_0 balances a steady load from the first frame on, before the integral has built up.

    Parameters
    ----------
    bound
        |h-hat| <= bound, as in `OutputFeedback`.
    filter_seconds
        The longest time constant tau in s; 0: no filter.
    integral_rate
        The largest rho in 1/s; 0: no integral.
    integrated
        Names of the integrated outputs; None: the first one.
    delay_seconds
        How long the law remembers its inputs, in s; 0: not at all.
    delay_rate
        |g| <= delay_rate, in 1/s.
    constant
        u_0 is within this share of the task's limits; 0: none.
    """

    def __init__(
        self,
        task: Task,
        bound: Bound = 10.0,
        filter_seconds: FilterSeconds = 0.0,
        integral_rate: IntegralRate = 0.0,
        integrated: list[str] | None = None,
        delay_seconds: DelaySeconds = 0.0,
        delay_rate: DelayRate = 100.0,
        constant: Constant = 0.0,
    ) -> None:
        names = [output.name for output in task.outputs]
        chosen = names[:1] if integrated is None else integrated
        for name in chosen:
            if name not in names:
                raise ValueError(f"integrated: no output is called {name}; available: {', '.join(names)}")
        m, q = len(task.inputs), len(task.outputs)
        self._task, self._m, self._q = task, m, q
        self._filters, self._integrates = filter_seconds > 0, integral_rate > 0
        self._delay = round(delay_seconds / task.time_step)  # frames
        self._rates = np.array([output.is_rate for output in task.outputs])
        self._integrated = np.array([name in chosen for name in names], dtype=np.float64)
        self._constant = constant > 0
        bounds = [(-bound, bound)] * (m * q)
        bounds += [(0.0, most) for most in (filter_seconds, integral_rate) if most > 0]
        bounds += [(-delay_rate, delay_rate)] * (m if self._delay else 0)
        if self._constant:
            bounds += zip(*(constant * each for each in task.input_bounds), strict=True)
        lower, upper = np.array(bounds).T
        self.bounds, self.n_parameters = (lower, upper), len(bounds)
        self.state_size = 2 * q + self._delay * m

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n), and the next y (q), rho w (q), last inputs (m d)."""
        q, m, d = self._q, self._m, self._delay
        H, smoothing, gathering, g, u_0 = self._parameters(theta)
        z = self._task.output(x)
        before, w, past = policy_state[..., :q], policy_state[..., q : 2 * q], policy_state[..., 2 * q :]
        y = before + smoothing * (z - before)
        past = past.reshape(*past.shape[:-1], m, d)
        asked = (H @ (y + w)[..., None])[..., 0] + g * past.sum(axis=-1) + u_0
        u = np.clip(asked, *self._task.input_bounds)
        free = (u == asked).all(axis=-1, keepdims=True)
        sent = np.concatenate([u[..., None], past], axis=-1)[..., :d]
        kept = [y, w + gathering * y * free, sent.reshape(*sent.shape[:-2], m * d)]
        return u, np.concatenate(kept, axis=-1)

    def imitating(self, states: Array, inputs: Array) -> Array:
        """The parameters (p,) that best imitate these inputs (k, T, m) at these states (k, T, n).

        They have no filter; with several integrals, one rho fits all of them best.
        """
        z, ones = self._task.output(states), np.ones((*states.shape[:2], 1))
        w = np.pad(np.cumsum(self.integrated(states), axis=1), ((0, 0), (1, 0), (0, 0)))[:, :-1]
        H, g, u_0, G = [], [], [], []
        for u in np.moveaxis(inputs, -1, 0):
            total = np.pad(np.cumsum(u, axis=1), ((0, 0), (self._delay + 1, 0)))
            past = total[:, self._delay :] - total[:, : total.shape[1] - self._delay]
            features = [z, past[:, :-1, None], self._constant * ones, w]
            gains = least_squares_gains(np.concatenate(features, axis=-1), u)
            H.append(gains[: self._q])
            g.append(gains[self._q] / self._task.time_step)
            u_0.append(gains[self._q + 1])
            G.append(gains[self._q + 2 :] / self._task.time_step)
        parts = [inverse_signed_exponential(np.concatenate(H)), np.zeros(int(self._filters))]
        if self._integrates:
            parts.append(self._rate(np.array(H), np.array(G)))
        parts += [np.array(g)] * (self._delay > 0) + [np.array(u_0)] * self._constant
        return np.clip(np.concatenate(parts), *self.bounds)

    def integrated(self, x: Array) -> Array:
        """The integrated outputs (..., i) at states x (..., n)."""
        return self._task.output(x)[..., (self._integrated > 0) & self._integrates]

    def _rate(self, H: Array, G: Array) -> Array:
        """rho (1,) for which rho H best fits the gains G (m, i) of the integrals."""
        own = H[:, self._integrated > 0]
        return np.array([np.sum(G * own) / (np.sum(own**2) + TINY)])

    def _parameters(self, theta: Array) -> tuple[Array, ...]:
        """H (..., m, q); rates of y and rho w per frame, (..., q); g in 1/frame and u_0, (..., m)."""
        h, rest = np.split(theta, [self._m * self._q], axis=-1)
        leading, dt = h.shape[:-1], self._task.time_step
        smoothing, gathering = np.ones((*leading, self._q)), np.zeros((*leading, self._q))
        g = u_0 = np.zeros((*leading, self._m))
        if self._filters:
            tau, rest = rest[..., :1], rest[..., 1:]
            with np.errstate(divide="ignore"):
                smoothing = np.where(self._rates, -np.expm1(-dt / tau), smoothing)
        if self._integrates:
            rho, rest = rest[..., :1], rest[..., 1:]
            gathering = dt * rho * self._integrated
        if self._delay:
            g, rest = dt * rest[..., : self._m], rest[..., self._m :]
        if self._constant:
            u_0 = rest
        return signed_exponential(h).reshape(*leading, self._m, self._q), smoothing, gathering, g, u_0
