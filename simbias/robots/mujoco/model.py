"""A robot's MuJoCo model as the nominal model."""

from __future__ import annotations

import os
from collections.abc import Sequence
from copy import copy
from typing import Any, final

import numpy as np
from numba import get_num_threads

from simbias.core import Kernel, Nominal, Task
from simbias.core.files import ConfigFile
from simbias.core.parameters import Parameter
from simbias.core.ranges import NonNegative
from simbias.core.records import Array, Indices
from simbias.robots.mujoco.kernel import ABSURD, EngineModel, Places, kernel
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import QUANTITIES, Factors, Values, changes, mujoco, values_of

FEW = 8  # states, for which threads take longer to begin than they save


@final
class Mujoco(Nominal):
    """f' of Eq. 1: a frame in MuJoCo, many states at once on all threads.

    A step begins without memory of the one before (no warm start), so that x_next is a function of x and u.

    Parameters
    ----------
    file, joints, actuators
        The robot (`simbias.robots.mujoco.mjcf.Mechanism`).
    values, factors
        Physical parameters that are set, and that are multiplied, by name
        (`simbias.robots.mujoco.parameters`).
    uncertainty
        Of parameters by name: the standard deviation of the logarithm or, where a value is zero, of the
        normal distribution, in the parameter's unit, whose upper half is its prior.

    Raises
    ------
    ValueError
        If the file cannot be read or does not go with the task, no parameter has such a name, or the robot
        has a state that the task's do not show.
    """

    batched = True
    kernel: Kernel

    def __init__(
        self,
        task: Task,
        file: ConfigFile,
        joints: list[str] | None = None,
        actuators: list[str] | None = None,
        values: Values | None = None,
        factors: Factors | None = None,
        uncertainty: dict[str, NonNegative] | None = None,
    ) -> None:
        robot = Mechanism(task, file, joints, actuators)
        if robot.hidden:
            raise ValueError(f"{file}: actuators with a state of their own: {', '.join(robot.hidden)}")
        self._robot = robot.with_values(changes(robot.model, values or {}, factors or {}))
        self._data: list[Any] = []  # what the engine works in, one for each thread
        self._model = EngineModel(self._robot.model)
        self._places = Places(self._model)
        self.kernel = kernel(self._robot, self._model, self._places)
        self.parameters = tuple(
            Parameter(
                name,
                QUANTITIES[name.rpartition(".")[2]].unit,
                value,
                spread,
                "log_normal" if value else "half_normal",
            )
            for pattern, spread in (uncertainty or {}).items()
            for name, value in values_of(self._robot.model, pattern).items()
        )

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n), one frame after x (..., n) under u (..., m)."""
        leading = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        x, u = (np.broadcast_to(a, (*leading, a.shape[-1])).reshape(-1, a.shape[-1]) for a in (x, u))
        return self._step_each([self._robot.model] * len(x), x, u).reshape(*leading, -1)

    def step_in_worlds(self, models: Sequence[Nominal], x: Array, u: Array, worlds: Indices) -> Array:
        """x_next (k, n), each row after x (k, n) under u (k, m) with the model of its world of (k,)."""
        engines = [model._robot.model for model in models if isinstance(model, Mujoco)]
        return self._step_each([engines[world] for world in worlds], x, u)

    def _step_each(self, models: Sequence[Any], x: Array, u: Array) -> Array:
        """x_next (k, n), each row with its model; what has blown up stays so."""
        x_next = np.full_like(x, np.nan)
        rows = np.flatnonzero((np.abs(x) < ABSURD).all(axis=1) & np.isfinite(u).all(axis=1))
        if len(rows):  # the engine dies of none
            x_next[rows] = self._step_possible([models[row] for row in rows.tolist()], x[rows], u[rows])
        return x_next

    def _step_possible(self, models: Sequence[Any], x: Array, u: Array) -> Array:
        """x_next (k, n), each row with its model."""
        robot = self._robot
        full, frames = robot.physics(x), robot.substeps
        after = np.empty((len(x), frames, full.shape[1]))
        threads = get_num_threads() if len(x) > FEW else 0
        while len(self._data) < max(1, threads):
            self._data.append(mujoco().MjData(robot.model))
        _pool(threads).rollout(
            models,
            self._data[: max(1, threads)],
            full,
            np.repeat(robot.controls(u)[:, None], frames, axis=1),
            nstep=frames,
            skip_checks=True,
            state=after,
            sensordata=np.empty((len(x), frames, robot.model.nsensordata)),
        )
        return robot.states(after[:, -1])

    def with_parameters(self, values: Array) -> Mujoco:
        """The model with other values (k,) of its parameters."""
        names = [parameter.name for parameter in self.parameters]
        changed = copy(self)
        changed._robot = self._robot.with_values(dict(zip(names, np.asarray(values).tolist(), strict=True)))
        changed._model = EngineModel(changed._robot.model)
        changed.kernel = kernel(changed._robot, changed._model, self._places)
        return changed


_POOLS: dict[int, Any] = {}  # threads that stay, by their number
_LOST: list[Any] = []  # pools of a process that this one was forked from: to end them would wait for ever


def _pool(threads: int) -> Any:
    """Threads that stay; none of them are as many as run without."""
    from mujoco.rollout import Rollout

    if threads not in _POOLS:
        _POOLS[threads] = Rollout(nthread=threads)
    return _POOLS[threads]


def _forget_pools() -> None:
    """Threads do not survive a fork."""
    _LOST.extend(_POOLS.values())
    _POOLS.clear()


os.register_at_fork(after_in_child=_forget_pools)
