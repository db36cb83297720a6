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

FEW = 64  # states, for which threads take longer to begin than they save


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
                "take away timeconst or dyntype"
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
        """x_next (..., n), one frame after x (..., n) under u (..., m); what has blown up stays so.

        Raises
        ------
        TypeError
            If x or u holds symbols, as where a policy that predicts is to be written down.
        """
        if object in (x.dtype, u.dtype):
            raise TypeError("the policy predicts by MuJoCo's engine, which is no formula")
        leading = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        x, u = (np.broadcast_to(a, (*leading, a.shape[-1])).reshape(-1, a.shape[-1]) for a in (x, u))
        x_next = np.full_like(x, np.nan)
        possible = (np.abs(x) < ABSURD).all(axis=1) & np.isfinite(u).all(axis=1)  # the engine dies of none
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
        """The model without friction of its joints; contacts keep theirs."""
        return self._with({f"{name}.friction": 0.0 for name in names_of(self._robot.model, "joint")})

    def without_input_limits(self) -> Mujoco:
        """The model whose motors are not limited."""
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
