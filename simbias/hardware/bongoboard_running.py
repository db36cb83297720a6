"""What the bongoboard is in any physics engine: where its bodies begin, and when its contacts have failed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from simbias.hardware.pymunk_world import places
from simbias.records import Array
from simbias.task.bongoboard import Bongoboard

_ABSURD = 1e3  # rad, rad/s: no body gets there within a frame but by numerical instability


class Engine(Protocol):
    """An engine's world, set to a start."""

    def step(self, torque: float) -> None:
        """One frame under an ankle torque (N m), half on each leg."""

    def state(self) -> Array:
        """The task's state (6,), of the bodies' angles and rates."""

    def wheel_and_board(self) -> tuple[Array, Array]:
        """Centre x, y (m) and global angle of wheel and board, (3,) each."""


class Running:
    """A robot under way (`simbias.hardware.loop.Robot`); its world is built by the first frame."""

    def __init__(
        self, task: Bongoboard, build: Callable[[Array], Engine], start: Array, detachment: float
    ) -> None:
        self._task = task
        self._build = build
        self._detachment = detachment
        self._x = np.asarray(start, dtype=np.float64)
        self._engine: Engine | None = None

    def state(self) -> Array:
        """The true state (6,)."""
        return self._x

    def step(self, u: Array) -> str | None:
        """One frame; a contact that has failed by what the engine says."""
        if self._engine is None:
            self._engine = self._build(self._x)
        self._engine.step(float(u[0]))
        x = self._engine.state()
        if not (np.abs(x) <= _ABSURD).all():
            self._x = np.full_like(x, np.nan)
            return None
        self._x = x
        depth, gap = contact(self._task, *self._engine.wheel_and_board())
        if depth > 0:
            return "board_touches_ground"
        return "board_leaves_wheel" if gap > self._detachment else None


def contact(task: Bongoboard, wheel: Array, board: Array) -> tuple[float, float]:
    """Depth (m) of the board's lowest corner in the floor, and gap (m) between wheel and board."""
    robot = task.robot
    half_length, half_thickness = robot.board_length / 2, robot.board_thickness / 2
    x, y, angle = board.tolist()
    c, s = math.cos(angle), math.sin(angle)
    depth = half_length * abs(s) + half_thickness * c - y
    right, up = wheel[0] - x, wheel[1] - y
    along, across = abs(right * c + up * s), abs(up * c - right * s)
    distance = math.hypot(max(along - half_length, 0.0), max(across - half_thickness, 0.0))
    return depth, distance - robot.wheel_radius


def motion(task: Bongoboard, start: Array, overlap: float = 0.0) -> dict[str, tuple[Array, Array]]:
    """Place x, y, angle and velocity of every body, (3,) each, at a start (6,)."""
    h = 1e-30  # complex step: the velocities are exact
    placed = places(task, start[:3] + 1j * h * start[3:], "plate", overlap)
    return {name: (place.real, place.imag / h) for name, place in placed.items()}
