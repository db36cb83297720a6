"""Runs as recorded and as models predict them, and how the board's scripts score both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from controllers import Controller, make

from simbias.core import Kernel
from simbias.core.records import Array, Indices

STEP = 0.002  # s, of the models, and of the motors' velocities
HEIGHT = 0.45  # m of the tip above the shoulder, 0.9 of its greatest
LENGTHS = (0.2, 0.3)  # m
ENOUGH = 0.99  # of an episode's duration: what is shorter has failed
TYPICAL = {
    "time": 20.0,
    "energy": 60.0,
    "torque": 100.0,
    "smoothness": 4.0,
    "velocity": 400.0,
}  # of the robot's score
STATES, COMMANDS, PUSHES = (
    [f"{name}{joint}" for name in names for joint in (1, 2)]
    for names in (("pos_meas", "vel_meas"), ("tau_con",), ("tau_pert",))
)


class Runs(NamedTuple):
    """Rows of some lanes' control loops: what was measured, and what was commanded."""

    times: Array  # (k,) s
    states: Array  # (k, lanes, 4)
    commands: Array  # (k, lanes, 2) N m
    rows: Indices  # (lanes,) before the loop stopped

    def outcomes(self, seconds: float, typical: Mapping[str, float] = TYPICAL) -> dict[str, Array]:
        """Success, time up in s, and score (lanes,), as the board has them (version 2)."""
        X, U, index = self.states, self.commands, np.arange(len(self.times))
        kept = index[:, None] < self.rows
        up = kept & (height(X) > HEIGHT)
        end = np.minimum(self.rows, len(self.times)) - 1
        swung = index[:, None] > np.max(np.where(kept & ~up, index[:, None], 0)[:-1], axis=0)
        begin = np.argmax(swung, axis=0)
        success = (self.times[end] >= ENOUGH * seconds) & (begin < end)
        steps, dt = kept[1:, :, None], np.diff(self.times)[:, None, None]
        changes = [np.std(np.diff(U[:n], axis=0)[:, i], axis=0).sum() for i, n in enumerate(self.rows)]
        costs = {
            "time": self.times[begin],
            "energy": np.sum(np.abs(np.diff(X[..., :2], axis=0) * U[:-1]) * steps, axis=(0, 2)),
            "torque": np.sum(U[:-1] ** 2 * dt * steps, axis=(0, 2)),
            "smoothness": np.array(changes),
            "velocity": np.sum(X[:-1, :, 2:] ** 2 * dt * steps, axis=(0, 2)),
        }
        losses = [np.tanh(np.pi * cost / typical[name]) for name, cost in costs.items()]
        time_up = np.sum(np.diff(self.times, prepend=0.0)[:, None] * up, axis=0)
        return {
            "success": success.astype(float),
            "up": time_up,
            "score": success * (1.0 - np.mean(losses, axis=0)),
        }


class Published(NamedTuple):
    """A set of runs of one controller on the robot."""

    declared: Mapping[str, Any]
    controller: Callable[[int, np.random.Generator], Controller]
    names: Sequence[str]
    recorded: Sequence[Runs]  # of one lane each
    pushes: Sequence[Array]  # (k, 2) N m, in each control period as declared
    rate: float  # Hz, as recorded


def published(declared: Mapping[str, Any], checkouts: Path) -> Published:
    """The runs of a set."""
    files = sorted((checkouts / declared["runs"]).glob("experiment*/trajectory.csv"))
    tables = [pd.read_csv(file) for file in files]
    most = np.array(declared["most"])
    runs = [
        Runs(
            table["time"].to_numpy(),
            table[STATES].to_numpy()[:, None],
            np.clip(table[COMMANDS].to_numpy(), -most, most)[:, None],
            np.array([len(table)]),
        )
        for table in tables
    ]
    pushes = [table[PUSHES].to_numpy() if set(PUSHES) <= set(table) else np.zeros((1, 2)) for table in tables]
    rate = 1.0 / float(np.median(np.concatenate([np.diff(run.times) for run in runs])))
    return Published(declared, make(declared, checkouts), [f.parent.name for f in files], runs, pushes, rate)


class Loop:
    """The lab's control loop of a set's runs, with some lanes for each.

    Angles are measured with white noise; a motor's velocities are their differences.
    """

    def __init__(
        self,
        own: Published,
        lanes: int,
        noise: Array,
        seconds: float,
        furthest: float,
        rng: np.random.Generator,
    ) -> None:
        self._own, self._lanes, self._noise, self._furthest, self._rng = own, lanes, noise, furthest, rng
        self.starts = np.repeat([[*run.states[0, 0, :2], 0.0, 0.0] for run in own.recorded], lanes, axis=0)
        self._controller = own.controller(len(self.starts), rng)
        self._measured, self._most = self.starts.copy(), np.array(own.declared["most"])
        self._rows = int(seconds * own.rate)
        self._states = np.zeros((self._rows, len(self.starts), 4), np.float32)
        self._commands = np.zeros((self._rows, len(self.starts), 2), np.float32)
        self._ends = np.full(len(self.starts), self._rows)
        self._errors = np.zeros((len(self.starts), 2))
        self._row, self._acting = 0, np.zeros((len(self.starts), 2))

    def acting(self, y: Array, t: float) -> Array:
        """Torques (lanes, 2) after states (lanes, 4) at time t: new ones when a control period begins."""
        row = self._row
        if row < self._rows and t * self._own.rate >= row - 1e-9:
            x = self._measured  # when the last command was given
            before, self._errors = self._errors, self._noise * self._rng.standard_normal((len(y), 2))
            self._measured = y + np.column_stack([self._errors, (self._errors - before) / STEP])
            u = np.clip(np.nan_to_num(self._controller.command(x, t)), -self._most, self._most)
            self._states[row], self._commands[row] = x, u
            out = ~(np.abs(x) < [self._furthest] * 2 + [self._own.declared["fastest"]] * 2).all(axis=1)
            self._ends[out] = np.minimum(self._ends[out], row)
            self._acting = u + np.repeat(self._pushes(t), self._lanes, axis=0)
            self._row += 1
        return self._acting

    def _pushes(self, t: float) -> Array:
        """Pushes (runs, 2) at time t; none behind what was recorded."""
        if not any(map(np.any, self._own.pushes)):
            return np.zeros((len(self._own.pushes), 2))
        index = int(t * self._own.declared["rate"] + 1e-9)
        return np.array([each[index] if index < len(each) else np.zeros(2) for each in self._own.pushes])

    def runs(self) -> Runs:
        """What came of it."""
        times = np.arange(self._rows) / self._own.rate
        return Runs(times, self._states, self._commands, np.maximum(self._ends, 2))


def predict(
    kernel: Kernel, memory: int, parameters: Array, loops: Sequence[Loop], seconds: float
) -> list[Runs]:
    """Runs of each loop under models with parameters (p, lanes) and a memory of so many numbers."""
    y = np.concatenate([loop.starts for loop in loops])
    borders = np.cumsum([len(loop.starts) for loop in loops])[:-1]
    P = tuple(np.tile(parameters, len(y) // parameters.shape[1]))
    kept = tuple(np.zeros((memory, len(y))))
    with np.errstate(all="ignore"):  # what overflows is out of bounds, and has ended
        for k in range(round(seconds / STEP)):
            parts = zip(loops, np.split(y, borders), strict=True)
            u = np.concatenate([loop.acting(part, k * STEP) for loop, part in parts])
            x, kept = kernel.function(tuple(y.T), tuple(u.T), P, kept)
            y = np.nan_to_num(np.clip(np.stack(x, axis=1), -1e3, 1e3))
    return [loop.runs() for loop in loops]


def height(states: Array) -> Array:
    """Heights (...) in m of the tip at states (..., 4)."""
    first, second = LENGTHS
    return -first * np.cos(states[..., 0]) - second * np.cos(states[..., 0] + states[..., 1])
