"""Components as somebody writes them who knows NumPy and no kernels; and one that only NumPy can run."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import wraps
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from simbias.core import Kernel, Nominal, Policy, Task
from simbias.core.records import Array
from simbias.learning.bias.none import ZeroBias
from simbias.simulation import closed_loop, open_loop
from simbias.simulation.compiled import CompiledSimulator


def predict_in_numpy(patch: pytest.MonkeyPatch) -> None:
    """Predict recordings and corrections without compiling, which takes longer than a few of them."""
    patch.setattr(open_loop, "of_nominal", lambda *_: SimpleNamespace(kernel=None))
    _correct_in_numpy(patch)


def simulate_in_numpy(patch: pytest.MonkeyPatch) -> None:
    """Simulate closed loops and corrections without compiling, likewise."""
    patch.setattr(CompiledSimulator, "of", lambda *_: None)
    _correct_in_numpy(patch)


def _correct_in_numpy(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(closed_loop, "corrections", lambda bias, x, u: bias.correction(x, u))


class CartPole(Nominal):
    """`simbias.robots.cartpole.CartPole` in matrices: M q'' = f, by Runge and Kutta's method."""

    def __init__(self, task: Task, values: Array) -> None:
        self._dt = task.time_step
        self.values = values  # masses of cart and pole, length, damping of cart and hinge, gravity

    def step(self, x: Array, u: Array) -> Array:
        k1 = self.rates(x, u)
        k2 = self.rates(x + self._dt / 2 * k1, u)
        k3 = self.rates(x + self._dt / 2 * k2, u)
        k4 = self.rates(x + self._dt * k3, u)
        return x + self._dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def rates(self, x: Array, u: Array) -> Array:
        cart, pole, length, cart_damping, hinge_damping, gravity = self.values
        q, v = x[..., 1], x[..., 2:]
        mass = np.empty_like(x, shape=(*q.shape, 2, 2))
        mass[..., 0, 0] = cart + pole
        mass[..., 0, 1] = mass[..., 1, 0] = pole * length / 2 * np.cos(q)
        mass[..., 1, 1] = pole * length**2 / 3
        centrifugal = pole * length / 2 * np.sin(q) * v[..., 1] ** 2
        weight = pole * gravity * length / 2 * np.sin(q)
        forces = np.stack([u[..., 0] + centrifugal, weight], axis=-1) - v * [cart_damping, hinge_damping]
        return np.concatenate([v, np.linalg.solve(mass, forces[..., None])[..., 0]], axis=-1)

    def with_parameters(self, values: Array) -> CartPole:
        changed = copy(self)
        changed.values = np.array(values)
        return changed


class Feedback(Policy):
    """`simbias.policy.output_feedback.OutputFeedback`, of arrays."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.n_parameters = len(task.inputs) * len(task.outputs)
        self.bounds = np.full(self.n_parameters, -10.0), np.full(self.n_parameters, 10.0)

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        gains = np.sign(theta) * np.expm1(np.abs(theta))
        H = gains.reshape(*theta.shape[:-1], len(self._task.inputs), len(self._task.outputs))
        u = np.einsum("...ij,...j->...i", H, self._task.output(x))
        return np.clip(u, -self._task.input_limit, self._task.input_limit), policy_state


def _correct(x: Array, u: Array, data: tuple[()], correction: Array) -> None:
    correction[:] = 1e-4 * x


class OfAllLanes(ZeroBias):
    """A correction by a kernel for all lanes at once, as those of Gaussian processes."""

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.kernel = Kernel(_correct, ())

    def correction(self, x: Array, u: Array) -> Array:
        return 1e-4 * x


def by_value(method: Callable) -> Callable:
    """A method that looks at values, so that its closed loop is simulated in NumPy."""

    @wraps(method)
    def call(*arguments: Any) -> Any:
        for each in arguments:
            if isinstance(each, np.ndarray):
                np.asarray(each, np.float64)
        return method(*arguments)

    return call
