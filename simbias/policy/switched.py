"""A network for the swing-up, and a linear-quadratic regulator near the goal."""

from __future__ import annotations

from copy import copy
from typing import Annotated, final

import numpy as np
from pydantic import Field

from simbias.core import Nominal, Policy, Task
from simbias.core.ranges import Bound, NonNegative, Positive
from simbias.core.records import Array
from simbias.policy.network import Kind, Network, Units
from simbias.policy.observer import ObserverKind
from simbias.simulation.goal import goal_along, held, holding, moves
from simbias.simulation.linearization import linear_regulator, linearization
from simbias.simulation.noise import QUIET, Variances

LEVELS = (-3.0, 3.0)  # logarithm of the level, in units of the largest level without input saturation
Hysteresis = Annotated[float, Field(ge=1, le=1e9)]


@final
class Switched(Policy):
    """The LQR of the nominal model where e^T S e is below a searched level; elsewhere a network.

    e is the error of the task's goal, which must cover all states and be an equilibrium; S solves the Riccati
    equation there, under the inputs that hold it. The regulator switches off where e^T S e exceeds
    `hysteresis` times the level.

    Parameters
    ----------
    kind, units, bound, observer, noise, latency
        Options of the network (`Network`). With a Kalman filter, the regulator is also designed on the
        identified model.
    input_weight
        Weight of a squared input at its limit, relative to a squared state error of one unit.
    hysteresis
        Ratio of the levels for switching off and on, at least 1.

    Raises
    ------
    ValueError
        If the goal does not cover all states, moves or cannot be held by the inputs, or the model has no
        regulator there.
    """

    def __init__(
        self,
        task: Task,
        nominal: Nominal,
        kind: Kind = "mlp",
        units: Units = 10,
        bound: Bound = 5.0,
        observer: ObserverKind = "none",
        input_weight: Positive = 10.0,
        hysteresis: Hysteresis = 2.0,
        noise: Variances = QUIET,
        latency: NonNegative = 0.0,
    ) -> None:
        if task.goals != task.states:
            raise ValueError("the task's goal must be all states, in their order")
        if moves(goal := goal_along(task)):
            raise ValueError("the task's goal moves, so no regulator holds it; use policy=mlp or trajectory")
        if not held(task, nominal, goal[0]):
            raise ValueError("the inputs cannot hold the task's goal, at which the regulator has to act")
        self._task, self._hysteresis, self._input_weight = task, hysteresis, input_weight
        self._swing_up = Network(
            task, nominal, kind, units, bound, observer=observer, noise=noise, latency=latency
        )
        self._K, self._S, self._holding = _regulator(task, nominal, input_weight)
        lower, upper = self._swing_up.bounds
        self.bounds = np.append(lower, LEVELS[0]), np.append(upper, LEVELS[1])
        self.n_parameters = len(lower) + 1
        self.state_size = self._swing_up.state_size + 1

    def designed_on(self, nominal: Nominal) -> Switched:
        """The policy; a Kalman filter and the regulator with it are redesigned on this model."""
        other = copy(self)
        other._swing_up = self._swing_up.designed_on(nominal)
        if other._swing_up is self._swing_up:
            return self
        other.state_size = other._swing_up.state_size + 1
        other._K, other._S, other._holding = _regulator(self._task, nominal, self._input_weight)
        return other

    def oddity(self, theta: Array) -> tuple[str, str] | None:
        """An oddity if the level of the policy theta (p,) is at its bound."""
        for side, bound in zip(("lower", "upper"), LEVELS, strict=True):
            if abs(bound - theta[-1]) < 0.01 * np.ptp(LEVELS):
                return "the level of a switched policy is at its bound", (
                    f"this policy's level, below which its regulator acts, is at its {side} bound: this says "
                    "little about where the regulator holds"
                )
        return None

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n); the observer's state, and 1 where the regulator is on."""
        kept, on = policy_state[..., :-1], policy_state[..., -1:]
        estimate = self._swing_up.estimate(theta[..., :-1], x, t, kept)
        met = self._swing_up.ahead(estimate, kept)
        e = self._task.error(met, t)
        V = ((e @ self._S) * e).sum(axis=-1, keepdims=True)
        near = np.exp(theta[..., -1:]) * (1.0 + (self._hysteresis - 1.0) * on) > V
        regulated = np.clip(self._holding - e @ self._K.T, *self._task.input_bounds)
        u = np.where(near, regulated, self._swing_up.ask(theta[..., :-1], met, t))
        kept = self._swing_up.keep(x, estimate, u, t, kept)
        return u, np.concatenate([kept, np.where(near, 1.0, 0.0)], axis=-1)


def _regulator(task: Task, nominal: Nominal, input_weight: float) -> tuple[Array, Array, Array]:
    """K (m, n), S (n, n) and u_0 (m,) of u = u_0 - K e, for the model with sliding joints.

    S is scaled so that e^T S e = 1 on the largest ellipsoid without input saturation.
    """
    end, limit = task.horizon * task.time_step, task.input_limit
    x = np.broadcast_to(task.reference(end), (len(task.states),))
    u = holding(task, nominal, x)
    A, B = linearization(nominal.without_dry_friction(), x, u, limit)
    R = input_weight * np.diag(limit**-2.0)
    try:
        K, S = linear_regulator(A, B, np.eye(len(x)), R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"the nominal model has no regulator at the goal: {error}") from error
    room = np.min(np.abs(np.subtract(task.input_bounds, u)), axis=0)
    largest = np.min(room**2 / np.einsum("ij,jk,ik->i", K, np.linalg.inv(S), K))
    return K, S / largest, u
