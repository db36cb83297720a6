"""A policy that follows a trajectory."""

from __future__ import annotations

from copy import copy
from typing import Annotated

import numpy as np
from pydantic import Field

from simbias.core import Law, Nominal, Policy, Task, wrapped
from simbias.core.ranges import NonNegative, Positive
from simbias.core.records import Array
from simbias.policy.observer import OBSERVERS, ObserverKind
from simbias.simulation.compiler import scheduled
from simbias.simulation.linearization import limits_of
from simbias.simulation.noise import QUIET, Variances

SMALL = 0.1  # maximum share of the input limits for the friction gains
LARGEST = 1e3  # bound on planned states, in their units
INPUTS, GAINS = 0.2, 0.9  # most that a search changes: inputs, as a share of the limits; gains, of themselves
Knots = Annotated[int, Field(ge=2, le=2000)]
SearchedKnots = Annotated[int, Field(ge=0, le=200)]
ObserverGain = Annotated[float, Field(ge=0.02, le=1)]


class Trajectory(Policy):
    """u = u_t - K_t (x - x_t) within the task's limits: feedforward and time-varying gains.

    x_t, u_t and K_t are linear in time between knots, which are evenly spaced over the horizon; afterwards
    the last ones apply. If the goal moves, the last gains are almost zero, since there is no cost after the
    horizon. With a Kalman filter, x is the predicted state when the input acts. Parameters are, knot by knot,
    x_t (n), u_t (m) and the rows of K_t (m n); with `sliding`, also those of L_t (m n). States that wrap are
    compared within half a turn.

    Parameters
    ----------
    bound
        Bound on the gains, in input limits per unit of a state.
    observer, noise
        As in `Network`.
    observer_gain
        Common value of the observer's gains, not used by a Kalman filter; 1 trusts the measurements.
    sliding
        Whether to plan with sliding joints. The inputs compensate for the dry friction that they can
        overcome, at the planned velocities. For friction in other joints, additional gains L_t act near rest
        on small deviations: L_t (x - x_t) is clipped to a tenth of the limits.
    resting
        Seconds at the end of the horizon that the plan spends at rest at the goal.
    searched_knots
        Number of times at which a search may change the inputs and gains of a planned policy; its changes are
        linear in between, and zero at the end. 0: it compares planned policies.

    Raises
    ------
    ValueError
        If the task has targets, each of which would need its own plan; if an input has no limit; or if
        `resting` leaves nothing of the horizon.
    """

    def __init__(
        self,
        task: Task,
        nominal: Nominal,
        knots: Knots = 51,
        bound: Positive = 1e3,
        observer: ObserverKind = "none",
        observer_gain: ObserverGain = 0.5,
        noise: Variances = QUIET,
        sliding: bool = False,
        resting: NonNegative = 0.0,
        searched_knots: SearchedKnots = 0,
    ) -> None:
        if task.targets:
            raise ValueError("follows one plan, but this task's targets need another one at each start")
        duration = task.horizon * task.time_step
        if resting > duration - task.time_step:
            raise ValueError(f"resting: expected less than the horizon's {duration:g} s, got {resting:g} s")
        self._task, self._knots, self.sliding, self.resting = task, knots, sliding, resting
        self._n, self._m = len(task.states), len(task.inputs)
        self._spacing, self.searched_knots = duration / (knots - 1), searched_knots
        self._observer = OBSERVERS[observer](task, nominal, noise)
        self._gains = np.full(len(self._observer.bounds[0]), observer_gain)
        self.state_size = self._observer.size
        lower, upper = limits_of(task)
        gains = np.repeat(bound * task.input_limit, self._n)
        states = np.full(self._n, LARGEST)
        self.bounds = (
            np.tile(np.concatenate([-states, lower, *[-gains] * (1 + sliding)]), knots),
            np.tile(np.concatenate([states, upper, *[gains] * (1 + sliding)]), knots),
        )
        self.n_parameters = len(self.bounds[0])

    def designed_on(self, nominal: Nominal) -> Trajectory:
        """The policy; a Kalman filter is redesigned on this model."""
        other = copy(self)
        other._observer = self._observer.designed_on(nominal)
        other.state_size = other._observer.size
        return self if other._observer is self._observer else other

    @property
    def frames_ahead(self) -> int:
        """Number of frames by which the state compared with x_t is ahead of the time."""
        return self._observer.frames_ahead

    @property
    def times(self) -> Array:
        """Times (K,) of the knots in s."""
        return self._spacing * np.arange(self._knots, dtype=np.float64)

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n), and the observer's state."""
        n, m = self._n, self._m
        row = scheduled(theta.reshape(*theta.shape[:-1], self._knots, -1), t, self._spacing)
        x_t, u_t, K_t = row[..., :n], row[..., n : n + m], row[..., n + m : n + m + m * n]
        estimate = self._observer.estimate(self._gains, x, t, policy_state)
        off = wrapped(self._observer.ahead(estimate, policy_state) - x_t, self._task.states)
        u = u_t - (K_t.reshape(*K_t.shape[:-1], m, n) @ off[..., None])[..., 0]
        if self.sliding:
            for_friction = (row[..., -m * n :].reshape(*K_t.shape[:-1], m, n) @ off[..., None])[..., 0]
            most = SMALL * self._task.input_limit
            u = u - np.clip(for_friction, -most, most)
        u = np.clip(u, *self._task.input_bounds)
        return u, self._observer.keep(x, estimate, u, t, policy_state)

    def following(self, states: Array, inputs: Array, *gains: Array) -> Array:
        """The parameters (p,) to follow x_t (K, n), u_t (K, m) with K_t and L_t (K, m, n) at the knots."""
        used = gains[: 1 + self.sliding]
        rows = np.concatenate([states, inputs, *(each.reshape(self._knots, -1) for each in used)], axis=1)
        return np.clip(rows.ravel(), *self.bounds)

    def planned(self, theta: Array) -> Array:
        """The states x_t (K, n) that the policy theta (p,) follows."""
        return theta.reshape(self._knots, -1)[:, : self._n]

    def directions(self, theta: Array) -> Array:
        """Changes of each input and each gain at each searched knot; gains that are zero stay zero."""
        sizes = GAINS * theta.reshape(self._knots, -1)[:, self._n :]
        sizes[:, : self._m] = INPUTS * self._task.input_limit
        places = np.linspace(0, self._knots - 1, self.searched_knots + 1)
        hats = [np.interp(np.arange(self._knots), places, each) for each in np.eye(len(places))[:-1]]
        changes = np.einsum(
            "sk,kc,cd->sdkc", np.reshape(hats, (-1, self._knots)), sizes, np.eye(sizes.shape[1])
        )
        whole = np.pad(changes, [(0, 0)] * 3 + [(self._n, 0)]).reshape(-1, len(theta))
        return whole[whole.any(axis=1)]

    def law(self, theta: Array) -> Law:
        """The law in words, with one row per knot."""
        beside = f" - clip(L_t (x - x_t), {SMALL:g} of the limits)" * self.sliding
        words = (
            f"u = u_t - K_t (x - x_t){beside}, cut off at the inputs' limits, linear between rows of "
            f"t, x_t, u_t, K_t{', L_t' * self.sliding}"
        )
        words += f"; x as {type(self._observer).__name__} estimates it" * (self.state_size > 0)
        if wrapping := [state.name for state in self._task.states if state.wraps]:
            words += f"; {', '.join(wrapping)} within half a turn of x_t"
        rows = theta.reshape(self._knots, -1)
        return Law(words, {"knots": np.concatenate([self.times[:, None], rows], axis=1)})
