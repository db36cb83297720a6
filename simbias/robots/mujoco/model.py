"""A robot's MuJoCo model as the nominal model."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import final

import numpy as np
from numba import get_num_threads

from simbias.core import Kernel, Nominal, Task
from simbias.core.files import ConfigFile
from simbias.core.parameters import uncertain
from simbias.core.ranges import NonNegative
from simbias.core.records import Array
from simbias.robots.mujoco.kernel import ABSURD, EngineModel, Places, kernel
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import Factors, Values, changes, mujoco, names_of, unit_of, values_of
from simbias.simulation.compiler import is_traced, traced_call

FEW = 64  # states: for fewer, starting threads takes longer than it saves


@final
class Mujoco(Nominal):
    """f' of Eq. 1: a frame in MuJoCo, for many states in parallel on all threads.

    A step has no memory of the previous one (no warm start), so x_next is a function of x and u.

    Parameters
    ----------
    file, joints, actuators
        The robot (`simbias.robots.mujoco.mjcf.Mechanism`).
    values, factors
        Physical parameters to set, and factors to multiply them by, by name
        (`simbias.robots.mujoco.parameters`).
    uncertainty
        Uncertainty of parameters by name: the standard deviation of the logarithm or, if a value is zero, of
        a half-normal prior's underlying normal distribution, in the parameter's unit.

    Raises
    ------
    ValueError
        If the file cannot be read or does not fit the task, no parameter has such a name, or the robot has a
        state that the task's states do not show.
    """

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
        self.source_files = robot.source_files
        if robot.hidden:
            raise ValueError(
                f"{file}: actuators with a state of their own are not supported: {', '.join(robot.hidden)}; "
                "remove timeconst or dyntype"
            )
        self._robot = robot.with_values(changes(robot.model, values or {}, factors or {}))
        self._model = EngineModel(self._robot.model)
        self._places = Places(self._model)
        self.kernel = kernel(self._robot, self._model, self._places)
        spreads = changes(self._robot.model, uncertainty or {}, {})
        for name in spreads:
            if self._robot.shares.get(name) == 0.0:
                raise ValueError(f"uncertainty: {name} is set to zero")
        known = values_of(self._robot.model, "*") | self._robot.shares
        units = {name: unit_of(self._robot.model, name) for name in known}
        self.parameters = uncertain(known, units, spreads)

    def step(self, x: Array, u: Array) -> Array:
        """x_next (..., n), one frame after x (..., n) under u (..., m); a diverged state stays diverged."""
        if is_traced(x, u):  # of a policy that predicts with this model
            return traced_call(self, self.kernel, x.shape[-1], x, u)
        leading = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        x, u = (np.broadcast_to(a, (*leading, a.shape[-1])).reshape(-1, a.shape[-1]) for a in (x, u))
        x_next = np.full_like(x, np.nan)
        possible = (np.abs(x) < ABSURD).all(axis=1) & np.isfinite(u).all(axis=1)  # safe for the engine
        if possible.any():
            x_next[possible] = self._step_possible(x[possible], u[possible])
        return x_next.reshape(*leading, -1)

    def _step_possible(self, x: Array, u: Array) -> Array:
        """x_next (k, n) of finite x (k, n) and u (k, m), on all threads if there are many."""
        from mujoco.rollout import Rollout

        robot = self._robot
        threads = get_num_threads() if len(x) > FEW else 0
        data = [mujoco().MjData(robot.model) for _ in range(max(1, threads))]
        with Rollout(nthread=threads) as rollout:
            after, _ = rollout.rollout(
                robot.model, data, robot.physics(x), robot.controls(u)[:, None], nstep=robot.substeps
            )
        return robot.states(after[:, -1])

    def mjcf(self) -> str:
        """The model as an MJCF file's text, to six digits."""
        return self._robot.text()

    def with_parameters(self, values: Array) -> Mujoco:
        """The model with other values (k,) of its parameters."""
        names = [parameter.name for parameter in self.parameters]
        return self._with(dict(zip(names, np.asarray(values).tolist(), strict=True)))

    def without_dry_friction(self) -> Mujoco:
        """The model without joint friction; contacts keep theirs."""
        return self._with({f"{name}.friction": 0.0 for name in names_of(self._robot.model, "joint")})

    def without_input_limits(self) -> Mujoco:
        """The model with unlimited motors."""
        return self._of(self._robot.without_input_limits())

    def _with(self, values: Mapping[str, float]) -> Mujoco:
        return self._of(self._robot.with_values(values))

    def _of(self, robot: Mechanism) -> Mujoco:
        """The model of another mechanism of the file."""
        changed = copy(self)
        changed._robot = robot
        changed._model = EngineModel(changed._robot.model)
        changed.kernel = kernel(changed._robot, changed._model, self._places)
        return changed
