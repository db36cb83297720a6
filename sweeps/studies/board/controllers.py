"""Published controllers of the double pendulum, of many runs at once.

A controller is made for a number of lanes and asked, at its own rate, for commands (lanes, 2) in N m after
measured states (lanes, 4). Angles are zero where it hangs, the second is relative to the first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import weights
from scipy.linalg import solve_continuous_are

from simbias.core.records import Array, Flags

GOAL = np.array([np.pi, 0.0, 0.0, 0.0])
SECTIONS = 40  # of time, in each of which a cubic polynomial stands for the trajectory and its gains
FRICTION = np.array([[0.16, 0.12], [0.001, 0.001]])  # Coulomb's in N m, viscous in N m s/rad: compensated for
SMOOTHING = np.array([1.0, 1.0, 0.2, 0.2])  # of the low-pass filter, in each control period
CUT = 0.1  # rad/s, below which it takes a velocity for zero


class Controller(Protocol):
    """A controller of some lanes, with their memory."""

    def command(self, x: Array, t: float) -> Array:
        """Commands (lanes, 2) after states (lanes, 4) as measured at time t in s."""


def make(declared: Mapping[str, Any], checkout: Path) -> Callable[[int, np.random.Generator], Controller]:
    """The controller that a set of runs declares, for any number of lanes."""
    of_kind = {"tvlqr": _of_tvlqr, "sac": _of_sac, "evolsac": _of_evolsac, "basis": _of_basis}
    return of_kind[declared["kind"]](declared, checkout)


class LowPass:
    """A controller whose states pass a low-pass filter, and which may compensate for friction."""

    def __init__(self, inner: Controller, lanes: int, friction: bool) -> None:
        self._inner, self._friction = inner, friction
        self._state = np.zeros((lanes, 4))

    def command(self, x: Array, t: float) -> Array:
        """The inner controller's command after filtered states, and what overcomes friction."""
        cut = x.copy()
        cut[:, 2:][np.abs(x[:, 2:]) < CUT] = 0.0
        self._state = (1.0 - SMOOTHING) * self._state + SMOOTHING * cut
        u = self._inner.command(self._state, t)
        v = self._state[:, 2:]
        return u + FRICTION[0] * np.arctan(100.0 * v) + FRICTION[1] * v if self._friction else u


class ThenLqr:
    """A swing-up, and LQR for good once the state comes near enough to the top."""

    def __init__(
        self, swing_up: Controller, lqr: Controller, near: Callable[[Array], Flags], lanes: int
    ) -> None:
        self._swing_up, self._lqr, self._near = swing_up, lqr, near
        self._caught = np.zeros(lanes, bool)

    def command(self, x: Array, t: float) -> Array:
        """Commands of the one or the other."""
        self._caught |= self._near(x)
        return np.where(self._caught[:, None], self._lqr.command(x, t), self._swing_up.command(x, t))


class Lqr:
    """LQR at the top, of the model as drawn; no torque where the cost is too large."""

    def __init__(self, Q: Array, R: Array, limits: Array, most: float) -> None:
        A, B = (matrix[0] for matrix in linearised(GOAL[None], np.zeros((1, 2)), limits > 0))
        self._S = solve_continuous_are(A, B, Q, R)
        self._K, self._limits, self._most = np.linalg.solve(R, B.T @ self._S), limits, most

    def command(self, x: Array, t: float) -> Array:
        """u = -K (x - goal), within limits."""
        e = np.column_stack(
            [x[:, 0] % (2 * np.pi) - np.pi, (x[:, 1] + np.pi) % (2 * np.pi) - np.pi, x[:, 2:]]
        )
        u = np.clip(-e @ self._K.T, -self._limits, self._limits)
        return np.where((np.einsum("ki,ij,kj->k", e, self._S, e) > self._most)[:, None], 0.0, u)


class Tvlqr:
    """Time-varying LQR about a published trajectory, smoothed by cubic polynomials in time."""

    def __init__(self, file: Path, Q: Array, R: Array, Qf: Array, limits: Array) -> None:
        table = pd.read_csv(file)
        times = table["time"].to_numpy()
        X, U = (table[names].to_numpy() for names in (["pos1", "pos2", "vel1", "vel2"], ["tau1", "tau2"]))
        gains = _riccati(X, U, times[1] - times[0], Q, R, Qf, limits > 0)
        values = np.column_stack([X, U, gains.reshape(len(times), 8)])
        parts = list(zip(np.array_split(times, SECTIONS), np.array_split(values, SECTIONS), strict=True))
        self._ends = np.array([part[-1] for part, _ in parts])
        self._fits = [np.polyfit(part - part[0], rows, 3) for part, rows in parts]
        self._begins = np.array([part[0] for part, _ in parts])
        self._limits = limits

    def command(self, x: Array, t: float) -> Array:
        """u = u_d(t) - K(t) (x - x_d(t)), within limits; what holds at the end holds from there on."""
        t = min(t, self._ends[-1])
        section = np.searchsorted(self._ends, t)
        at = (t - self._begins[section]) ** np.arange(3, -1, -1) @ self._fits[section]
        e = x - at[:4]
        e[:, :2] = _wrapped(e[:, :2])
        return np.clip(at[4:6] - e @ at[6:].reshape(2, 4).T, -self._limits, self._limits)


class Basis:
    """Squashed sums of Gaussians, one for each joint, which wait at first (MC-PILCO's)."""

    def __init__(self, file: Path, limits: Array, wait: int) -> None:
        self._joints, self._limits, self._wait = weights.of_basis_functions(file), limits, wait

    def command(self, x: Array, t: float) -> Array:
        """Commands after velocities, cosines and sines."""
        if self._wait:
            self._wait -= 1
            return np.zeros((len(x), 2))
        features = np.column_stack([x[:, 2:], np.cos(x[:, :2]), np.sin(x[:, :2])])
        columns = []
        for (scales, centres, w), limit in zip(self._joints, self._limits, strict=True):
            z = features / scales
            squares = (z**2).sum(1)[:, None] - 2.0 * z @ centres.T + (centres**2).sum(1)
            columns.append(limit * np.tanh(np.exp(-squares) @ w / limit))
        return np.column_stack(columns)


class Network:
    """A perceptron's squashed mean, or a sample, at the first joint; asked in every so many periods."""

    def __init__(
        self,
        file: Path,
        limit: float,
        observe: Callable[[Array], Array],
        rng: np.random.Generator | None = None,
        every: int = 1,
    ) -> None:
        layers = ["actor.latent_pi.0", "actor.latent_pi.2"]
        self._hidden = weights.of_network(file, layers)
        self._mean, self._deviation = weights.of_network(file, ["actor.mu", "actor.log_std"])
        self._limit, self._observe, self._rng, self._every = limit, observe, rng, every
        self._asked, self._last = 0, np.zeros(0)

    def command(self, x: Array, t: float) -> Array:
        """Commands at the first joint."""
        if self._asked % self._every == 0:
            h = self._observe(x).astype(np.float32)
            for W, b in self._hidden:
                h = np.maximum(h @ W + b, 0.0)
            a = (h @ self._mean[0] + self._mean[1])[:, 0]
            if self._rng is not None:
                deviation = np.exp(np.clip((h @ self._deviation[0] + self._deviation[1])[:, 0], -20.0, 2.0))
                a = a + deviation * self._rng.standard_normal(len(x), np.float32)
            self._last = self._limit * np.tanh(a)
        self._asked += 1
        return np.column_stack([self._last, np.zeros(len(x))])


def linearised(X: Array, U: Array, driven: Flags, step: float = 1e-6) -> tuple[Array, Array]:
    """A (k, 4, 4) and B (k, 4, 2) of x' = A x + B u at states (k, 4) and torques (k, 2), without friction."""
    k, A = len(X), np.zeros((len(X), 4, 4))
    A[:, [0, 1], [2, 3]] = 1.0
    for i in range(4):
        d = step * np.eye(4)[i]
        A[:, 2:, i] = (_accelerations(X + d, U * driven) - _accelerations(X - d, U * driven)) / (2 * step)
    B = np.zeros((k, 4, 2))
    B[:, 2:] = np.linalg.inv(_inertias(X)) * driven
    return A, B


# Of design C.1 as drawn: inertias about joints, the first length, the second link, and torques of gravity.
I_1, I_2, L_1 = 0.031887199591513114, 0.05086984812807257, 0.2
M_2, R_2 = 0.6255677234174437, 0.25569305436052964
G_1, G_2 = 9.81 * (0.5234602302310271 * 0.2 + M_2 * L_1), 9.81 * M_2 * R_2
COUPLING = M_2 * L_1 * R_2


def _inertias(X: Array) -> Array:
    """Inertia matrices (k, 2, 2)."""
    c = COUPLING * np.cos(X[:, 1])
    m_11, m_12 = I_1 + I_2 + M_2 * L_1**2 + 2.0 * c, I_2 + c
    return np.stack([np.stack([m_11, m_12], -1), np.stack([m_12, np.full_like(c, I_2)], -1)], -2)


def _accelerations(X: Array, U: Array) -> Array:
    """Accelerations (k, 2) under torques (k, 2)."""
    (q_1, q_2, v_1, v_2), h = X.T, COUPLING * np.sin(X[:, 1])
    f_1 = U[:, 0] + h * v_2 * (2.0 * v_1 + v_2) - G_1 * np.sin(q_1) - G_2 * np.sin(q_1 + q_2)
    f_2 = U[:, 1] - h * v_1**2 - G_2 * np.sin(q_1 + q_2)
    return np.linalg.solve(_inertias(X), np.column_stack([f_1, f_2])[..., None])[..., 0]


def _riccati(X: Array, U: Array, dt: float, Q: Array, R: Array, Qf: Array, driven: Flags) -> Array:
    """Gains (k, 2, 4) along a trajectory, of Euler's discretisation; zero at its end."""
    A, B = linearised(X, U, driven)
    A, B, P, K = np.eye(4) + dt * A, dt * B, Qf, np.zeros((len(X), 2, 4))
    for i in range(len(X) - 2, -1, -1):
        K[i] = np.linalg.solve(R + B[i].T @ P @ B[i], B[i].T @ P @ A[i])
        P = Q + A[i].T @ P @ (A[i] - B[i] @ K[i])
    return K


def _wrapped(angles: Array) -> Array:
    """Angles within +-pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _scaled(fastest: float) -> Callable[[Array], Array]:
    """States as networks take them: 1 is half a turn, or this velocity in rad/s."""
    return lambda x: np.column_stack(
        [(x[:, :2] % (2 * np.pi) - np.pi) / np.pi, np.clip(x[:, 2:], -fastest, fastest) / fastest]
    )


def _lqr_of(declared: Mapping[str, Any], checkout: Path) -> tuple[Lqr, Callable[[Array], Flags], Array]:
    """A published LQR, where it takes over, and the matrix of that region."""
    folder, limits, scale = checkout / declared["lqr"], np.array(declared["limits"]), declared["lqr_scale"]
    costs, S, rho = (np.loadtxt(folder / name) for name in ("controller_par.csv", "Smatrix", "rho"))
    lqr = Lqr(np.diag(costs[:4]), scale * costs[4] * np.eye(2), limits, declared["lqr_most"])

    def near(x: Array) -> Flags:
        e = np.column_stack([_wrapped(x[:, :2]), x[:, 2:]]) - GOAL
        if declared["from_both_sides"]:
            e[:, :2] = _wrapped(e[:, :2])
        return np.einsum("ki,ij,kj->k", e, S, e) < rho

    return lqr, near, S


def _of_tvlqr(
    declared: Mapping[str, Any], checkout: Path
) -> Callable[[int, np.random.Generator], Controller]:
    limits = np.array(declared["limits"])
    lqr, near, S = _lqr_of(declared, checkout)
    Qf = S if declared["Qf"] == "S" else np.diag(declared["Qf"])
    Q, R = np.diag(declared["Q"]), declared["R"] * np.eye(2)
    tvlqr = Tvlqr(checkout / declared["trajectory"], Q, R, Qf, limits)
    return lambda lanes, rng: LowPass(ThenLqr(tvlqr, lqr, near, lanes), lanes, friction=True)


def _of_sac(declared: Mapping[str, Any], checkout: Path) -> Callable[[int, np.random.Generator], Controller]:
    (lqr, near, _), file, limit = (
        _lqr_of(declared, checkout),
        checkout / declared["policy"],
        declared["limits"][0],
    )

    def made(lanes: int, rng: np.random.Generator) -> Controller:
        policy = Network(file, limit, lambda x: x, rng)
        return LowPass(ThenLqr(policy, lqr, near, lanes), lanes, friction=True)

    return made


def _of_evolsac(
    declared: Mapping[str, Any], checkout: Path
) -> Callable[[int, np.random.Generator], Controller]:
    file, (limit, _), observe = checkout / declared["policy"], declared["limits"], _scaled(declared["scale"])
    every = declared["every"]
    return lambda lanes, rng: LowPass(Network(file, limit, observe, every=every), lanes, friction=False)


def _of_basis(
    declared: Mapping[str, Any], checkout: Path
) -> Callable[[int, np.random.Generator], Controller]:
    file, limits, wait = checkout / declared["policy"], np.array(declared["limits"]), declared["wait"]
    return lambda lanes, rng: Basis(file, limits, wait)
