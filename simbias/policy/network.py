"""A small network as policy, and its possible architectures."""

from __future__ import annotations

from copy import copy
from typing import Annotated, Literal, final

import numpy as np
from pydantic import Field

from simbias.core import Nominal, Policy, Task
from simbias.core.ranges import Bound, NonNegative
from simbias.core.records import Array
from simbias.policy.observer import OBSERVERS, LookAhead, ObserverKind
from simbias.simulation.linearization import limits_of
from simbias.simulation.noise import QUIET, Variances

Kind = Literal["mlp", "rbf"]
Units = Annotated[int, Field(ge=1, le=200)]


class Perceptron:
    """tanh(W_2 tanh(W_1 z + b_1) + b_2): one hidden layer."""

    def __init__(self, q: int, m: int, units: int, bound: float) -> None:
        self._shapes = (units, q), (units, 1), (m, units), (m, 1)
        p = sum(rows * columns for rows, columns in self._shapes)
        self.bounds = np.full(p, -bound), np.full(p, bound)

    def __call__(self, weights: Array, z: Array) -> Array:
        """Values (..., m) at z (..., q)."""
        W_1, b_1, W_2, b_2 = _matrices(weights, self._shapes)
        return np.tanh(W_2 @ np.tanh(W_1 @ z[..., None] + b_1) + b_2)[..., 0]


class RadialBasis:
    """Radial basis functions with centres and common widths, squashed by (9 sin v + sin 3v) / 8.

    As in M. P. Deisenroth, C. E. Rasmussen, PILCO: A Model-Based and Data-Efficient Approach, 2011.
    """

    def __init__(self, q: int, m: int, units: int, bound: float) -> None:
        self._shapes = (units, q), (1, q), (m, units)
        sizes = [rows * columns for rows, columns in self._shapes]
        upper = np.repeat([bound, np.log(1 + bound), bound], sizes)
        self.bounds = -upper, upper

    def __call__(self, weights: Array, z: Array) -> Array:
        """Values (..., m) at z (..., q)."""
        centres, log_widths, W = _matrices(weights, self._shapes)
        squares = np.square((z[..., None, :] - centres) * np.exp(-log_widths)).sum(axis=-1)
        v = (W @ np.exp(-0.5 * squares)[..., None])[..., 0]
        return (9.0 * np.sin(v) + np.sin(3.0 * v)) / 8.0


def _matrices(weights: Array, shapes: tuple[tuple[int, int], ...]) -> list[Array]:
    """Weights (..., p) as matrices (..., rows, columns)."""
    matrices, begin = [], 0
    for rows, columns in shapes:
        end = begin + rows * columns
        matrices.append(weights[..., begin:end].reshape(*weights.shape[:-1], rows, columns))
        begin = end
    return matrices


NETWORKS: dict[Kind, type[Perceptron | RadialBasis]] = {"mlp": Perceptron, "rbf": RadialBasis}


@final
class Network(Policy):
    """u = the middle of the input limits + half their width times a network of the outputs.

    Parameters
    ----------
    kind
        "mlp": one hidden layer with tanh; "rbf": radial basis functions.
    units
        Number of hidden units or basis functions.
    bound
        Bound on the weights.
    errors
        Whether the errors of the task's goal are also inputs of the network.
    observer
        "filter": a low-pass filter of rates; "derivative": rates from positions; "model": corrected
        predictions of the declared nominal model. The gains of these are searched. "kalman": a Kalman filter
        of the identified nominal model. "disturbance": one that also estimates steady forces that the model
        lacks. "none": the network uses the measured state.
    noise
        Measurement noise variances, by name (`simbias.simulation.noise.Noise`), that the Kalman filter
        assumes.
    latency
        Delay in s of measurements or inputs, in addition to delays in a Kalman filter's model: the network
        acts on the state that the nominal model predicts from the inputs sent since.

    Raises
    ------
    ValueError
        If an input has no limit, or there is a latency with a disturbance observer.
    """

    def __init__(
        self,
        task: Task,
        nominal: Nominal,
        kind: Kind = "mlp",
        units: Units = 10,
        bound: Bound = 5.0,
        errors: bool = False,
        observer: ObserverKind = "none",
        noise: Variances = QUIET,
        latency: NonNegative = 0.0,
    ) -> None:
        self._task, self._errors = task, errors
        q = len(task.outputs) + errors * len(task.goals)
        self._network = NETWORKS[kind](q, len(task.inputs), units, bound)
        self._observer = OBSERVERS[observer](task.without_targets, nominal, noise)
        if latency and observer == "disturbance":
            raise ValueError("latency: observer=disturbance takes delays from the model; declare them there")
        if latency:
            self._observer = LookAhead(task.without_targets, nominal, self._observer, latency)
        self._n = len(task.without_targets.states)
        parts = (self._network.bounds, self._observer.bounds)
        lower, upper = (np.concatenate(each) for each in zip(*parts, strict=True))
        self.bounds, self.n_parameters = (lower, upper), len(lower)
        self._weights = len(self._network.bounds[0])
        self.state_size = self._observer.size
        least, most = limits_of(task)
        self._middle, self._half = (most + least) / 2, (most - least) / 2

    def designed_on(self, nominal: Nominal) -> Network:
        """The network; a Kalman filter is redesigned on this model."""
        other = copy(self)
        other._observer = self._observer.designed_on(nominal)
        other.state_size = other._observer.size
        return self if other._observer is self._observer else other

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        """Inputs u (..., m) at states x (..., n), and the observer's state."""
        estimate = self.estimate(theta, x, t, policy_state)
        u = self.ask(theta, self.ahead(estimate, policy_state), t)
        return u, self.keep(x, estimate, u, t, policy_state)

    def estimate(self, theta: Array, x: Array, t: float, kept: Array) -> Array:
        """The observer's estimate (..., n) of the state; its own state is (..., s)."""
        own = self._observer.estimate(theta[..., self._weights :], x[..., : self._n], t, kept)
        return self._with_targets(own, x)

    def ask(self, theta: Array, estimate: Array, t: float) -> Array:
        """Inputs u (..., m) at an estimate (..., n) of the state when they act, which is ahead of time t."""
        z = self._task.output(estimate)
        if self._errors:
            acting = t + self._observer.seconds_ahead if self._observer.seconds_ahead else t
            z = np.concatenate([z, self._task.error(estimate, acting)], axis=-1)
        return self._middle + self._half * self._network(theta[..., : self._weights], z)

    def ahead(self, estimate: Array, kept: Array) -> Array:
        """The state (..., n) when the next input acts, predicted by the observer."""
        return self._with_targets(self._observer.ahead(estimate[..., : self._n], kept), estimate)

    def keep(self, x: Array, estimate: Array, u: Array, t: float, kept: Array) -> Array:
        """The observer's state (..., s) for the next frame."""
        return self._observer.keep(x[..., : self._n], estimate[..., : self._n], u, t, kept)

    def _with_targets(self, own: Array, x: Array) -> Array:
        """The robot's own states combined with the known targets in x (..., n)."""
        return np.concatenate([own, x[..., self._n :]], axis=-1)
