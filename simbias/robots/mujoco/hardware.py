"""A robot's MuJoCo model instead of the robot."""

from __future__ import annotations

from typing import final

import numpy as np

from simbias.core import Hardware, Policy, Task
from simbias.core.files import ConfigFile
from simbias.core.ranges import DelayFrames
from simbias.core.records import Array, Rollout
from simbias.robots.mujoco.mjcf import Mechanism
from simbias.robots.mujoco.parameters import Factors, Values, changes, mujoco
from simbias.simulation.control_loop import Record, Robot, experiment
from simbias.simulation.noise import QUIET, Noise, Variances


@final
class Mujoco(Hardware):
    """The robot in a file, with physical parameters that are wrong or missing in the nominal model.

    Parameters
    ----------
    file, joints, actuators
        The robot (`simbias.robots.mujoco.mjcf.Mechanism`).
    values, factors
        Physical parameters to set, and factors to multiply them by, by name
        (`simbias.robots.mujoco.parameters`).
    delay
        Frames until an input acts; until then, inputs are zero.
    noise
        Variances of noise on the inputs and on the states that the policy sees, by name (`Noise`).
    record
        The states used by cost and learning: the true or the measured ones.
    """

    def __init__(
        self,
        task: Task,
        file: ConfigFile,
        joints: list[str] | None = None,
        actuators: list[str] | None = None,
        values: Values | None = None,
        factors: Factors | None = None,
        delay: DelayFrames = 0,
        noise: Variances = QUIET,
        record: Record = "true_state",
    ) -> None:
        robot = Mechanism(task, file, joints, actuators)
        self.source_files = robot.source_files
        self._robot = robot.with_values(changes(robot.model, values or {}, factors or {}))
        self._task = task
        self._delay = delay
        self._noise = Noise(task, noise)
        self._record = record

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment with theta (p,) from start (n,); its cost is not set."""
        robot = _Running(self._task, self._robot, start, self._delay)
        return experiment(self._task, robot, policy, theta, self._noise.draw(rng), self._record)


class _Running(Robot):
    """A running experiment in the engine."""

    def __init__(self, task: Task, robot: Mechanism, start: Array, delay: int) -> None:
        self._task = task
        self._robot = robot
        self._engine = mujoco()
        self._data = self._engine.MjData(robot.model)
        self._part = self._engine.mjtState.mjSTATE_FULLPHYSICS
        full = robot.physics(start[None])[0]
        self._engine.mj_setState(robot.model, self._data, full, self._part)
        self._waiting = [np.zeros(len(robot.model.actuator_gear))] * delay

    def state(self) -> Array:
        """The state (n,)."""
        full = np.empty(self._engine.mj_stateSize(self._robot.model, self._part))
        self._engine.mj_getState(self._robot.model, self._data, full, self._part)
        return self._robot.states(full[None])[0]

    def step(self, u: Array) -> None:
        """One frame under the input u (m,), or a delayed one."""
        self._waiting.append(self._robot.controls(u[None])[0])
        self._data.ctrl[:] = self._waiting.pop(0)
        self._engine.mj_step(self._robot.model, self._data, nstep=self._robot.substeps)

    def failure(self) -> str | None:
        """The violated criterion of the task."""
        return self._task.failure(self.state())
