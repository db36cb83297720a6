"""The board's plant, a double pendulum without friction that is stepped as theirs is, and its resets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rollouts import LENGTHS

from simbias.core.records import Array, Flags

STEP, LIMIT = 0.002, 6.0  # s, N m
GEAR, GRAVITY = 6.0, 9.81
PLANT = {  # design C.1 without friction; inertias about joints
    "m_1": 0.5234602302310271,
    "m_2": 0.6255677234174437,
    "r_1": 0.2,
    "r_2": 0.25569305436052964,
    "I_1": 0.031887199591513114,
    "I_2": 0.05086984812807257,
    "b_1": 0.0,
    "b_2": 0.0,
    "c_1": 0.0,
    "c_2": 0.0,
    "rotor": 0.0,
}
FRICTION = {"b_1": 0.001, "b_2": 0.001, "c_1": 0.16, "c_2": 0.12, "rotor": 6.287203962819607e-5}  # the lab's
MINUTE, RESETS, RESET = 60.0, 15, 0.2  # s, of which each takes so long
GAINS = (10.0, 0.1, 1.0)  # of their PID, which counts each step as 1 ms
PID_STEP = 0.001


def step(x: Array, u: Array, plant: Mapping[str, Any]) -> Array:
    """States (lanes, 4) a step after x under torques u (lanes, 2), by the classical Runge-Kutta method."""

    def derivative(x: Array) -> Array:
        return np.column_stack(derivatives(x.T, u.T, plant))

    k_1 = derivative(x)
    k_2 = derivative(x + 0.5 * STEP * k_1)
    k_3 = derivative(x + 0.5 * STEP * k_2)
    k_4 = derivative(x + STEP * k_3)
    return x + STEP / 6.0 * (k_1 + 2.0 * (k_2 + k_3) + k_4)


def derivatives(x: Any, u: Any, p: Mapping[str, Any]) -> list[Any]:
    """Velocities and accelerations, four in all, at states x (4, ...) under torques u (2, ...)."""
    _, q_2, v_1, v_2 = x
    h, weight = p["m_2"] * LENGTHS[0] * p["r_2"], gravity(x, p)
    c, s = h * np.cos(q_2), h * np.sin(q_2)
    m_11 = p["I_1"] + p["I_2"] + p["m_2"] * LENGTHS[0] ** 2 + 2.0 * c + (GEAR**2 + 1.0) * p["rotor"]
    m_12, m_22 = p["I_2"] + c - GEAR * p["rotor"], p["I_2"] + GEAR**2 * p["rotor"]
    f_1 = u[0] + s * v_2 * (2.0 * v_1 + v_2) - weight[0]
    f_1 = f_1 - p["b_1"] * v_1 - p["c_1"] * np.arctan(100.0 * v_1)
    f_2 = u[1] - s * v_1**2 - weight[1] - p["b_2"] * v_2 - p["c_2"] * np.arctan(100.0 * v_2)
    determinant = m_11 * m_22 - m_12**2
    return [v_1, v_2, (m_22 * f_1 - m_12 * f_2) / determinant, (m_11 * f_2 - m_12 * f_1) / determinant]


def gravity(x: Any, p: Mapping[str, Any]) -> tuple[Any, Any]:
    """Torques that hold the plant at rest at states x (4, ...)."""
    second = GRAVITY * p["m_2"] * p["r_2"] * np.sin(x[0] + x[1])
    first = GRAVITY * (p["m_1"] * p["r_1"] + p["m_2"] * LENGTHS[0]) * np.sin(x[0])
    return first + second, second


class Reset:
    """The PID with gravity compensation that takes each lane's robot to angles (lanes, 2) of its own."""

    def __init__(self, lanes: int) -> None:
        self._before, self._total, self._seen = (np.zeros((lanes, 2)) for _ in range(3))

    def torques(self, x: Array, angles: Array, held: Flags, plant: Mapping[str, Any]) -> Array:
        """Torques (lanes, 2) at states x (lanes, 4); only who is `held` is counted."""
        now = held[:, None]
        error = angles - x[:, :2]
        self._total, self._seen = self._total + now * error, self._seen + now
        rate = np.where(self._seen > 2, (error - self._before) / PID_STEP, 0.0)
        self._before = np.where(now, error, self._before)
        pid = GAINS[0] * error + GAINS[1] * PID_STEP * self._total + GAINS[2] * rate
        return np.clip(pid, -LIMIT, LIMIT) + np.column_stack(gravity(x.T, plant))


def resets(seed: int) -> tuple[Array, Array]:
    """Angles (15, 2) that the PID is to reach, and when it begins (16,), as their scripts draw them."""
    rng = np.random.RandomState(seed)
    angles = rng.uniform(0.0, 2 * np.pi, (10 * RESETS + 1, 4)) - np.pi
    between = MINUTE / (RESETS + 1)
    begins = np.linspace(between, MINUTE - between, RESETS) + 2.0 * (rng.rand(RESETS) - 0.5)
    return angles[:RESETS, :2], np.append(begins, np.inf)
