"""RealAIGym's own simulator of the double pendulum as the hardware of a trial.

    ln -s CHECKOUT double_pendulum
    export PYTHONPATH=sweeps/studies/board
    conf="--config-dir sweeps/studies/board/conf"
    python -m simbias $conf preset=pendubot_trajectory hardware=their_simulator
    python -m simbias $conf +sweep=their_simulator

CHECKOUT is one of github.com/dfki-ric-underactuated-lab/double_pendulum, whose code runs here as it is: the
plant, its Runge-Kutta steps, what its motors and sensors do. Its parameters are those that the lab
identified on the robot, with friction and rotor inertia; a trial's model has neither.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import Field

from simbias.core import Hardware, HardwareError, Policy, Task
from simbias.core.ranges import DelayFrames
from simbias.core.records import Array, Rollout
from simbias.simulation.control_loop import Record, Robot, experiment
from simbias.simulation.noise import QUIET, Noise, Variances

STEP, LIMIT = 0.001, 6.0  # s, N m
HANGING = np.array([np.pi, 0.0, 0.0, 0.0])  # theirs is 0 where the task's first angle is half a turn
PARAMETERS = "data/system_identification/identified_parameters/design_C.1/model_1.0/model_parameters.yml"
Response = Annotated[float, Field(gt=0.0, le=2.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


@final
class TheirSimulator(Hardware):
    """The double pendulum "design C.1" with the friction that was identified, one joint driven.

    Parameters
    ----------
    checkout
        The folder of their repository.
    driven
        The joint with a motor.
    response
        k in u = u_last + k (u_asked - u_last), in each of their steps of 1 ms.
    delay
        Frames by which all that is measured is late.
    compensated
        The share of the passive joint's dry friction that its motor takes away, as on the robot.
    noise
        Variances on the input and on what the policy sees, by name (`Noise`).
    record
        What cost and learning get to see: the true states, or the measured ones.

    Raises
    ------
    ValueError
        If there is no such checkout, or the task's frames are no whole number of steps.
    """

    def __init__(
        self,
        task: Task,
        checkout: str,
        driven: Literal["first", "second"],
        response: Response = 1.0,
        delay: DelayFrames = 0,
        compensated: Share = 0.0,
        noise: Variances = QUIET,
        record: Record = "true_state",
    ) -> None:
        self._task, self._noise, self._record = task, Noise(task, noise), record
        self._response, self._delay = response, delay * task.time_step
        self._steps = round(task.time_step / STEP)
        if not np.isclose(self._steps * STEP, task.time_step):
            raise ValueError(f"task.time_step: expected a multiple of {STEP:g} s, got {task.time_step:g} s")
        self._simulator, self._joint = _simulator(Path(checkout), driven, compensated)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,) from start (4,); its cost is not set."""
        if not np.isfinite(start).all():
            raise HardwareError(f"the robot cannot start at {start}")
        simulator = self._simulator
        simulator.reset()
        simulator.set_measurement_parameters(delay=self._delay, delay_mode="posvel")
        simulator.set_motor_parameters(u_responsiveness=self._response)
        robot = _Running(self._task, simulator, self._joint, self._steps, start)
        return experiment(self._task, robot, policy, theta, self._noise.draw(rng), self._record)


class _Running(Robot):
    """An experiment under way, from a start (4,)."""

    def __init__(self, task: Task, simulator: Any, joint: int, steps: int, start: Array) -> None:
        self._task, self._simulator, self._joint, self._steps = task, simulator, joint, steps
        simulator.set_state(0.0, start + HANGING)
        simulator.record_data(0.0, start + HANGING)

    def state(self) -> Array:
        """The state (4,)."""
        return self._simulator.x - HANGING

    def reading(self) -> Array:
        """What their sensors tell (4,), late."""
        return self._simulator.get_measurement(STEP) - HANGING

    def step(self, u: Array) -> None:
        """One frame under the torque u (1,)."""
        asked = np.zeros(2)
        asked[self._joint] = u[0]
        for _ in range(self._steps):
            self._simulator.step(self._simulator.get_real_applied_u(asked, self._simulator.t, STEP), STEP)

    def failure(self) -> str | None:
        """The task's criterion that it violates."""
        return self._task.failure(self.state())


def _simulator(checkout: Path, driven: str, compensated: float) -> tuple[Any, int]:
    """Their simulator with the lab's parameters, and the driven joint's index."""
    source = checkout / "src" / "python"
    if not (source / "double_pendulum").is_dir():
        raise ValueError(f"checkout: {checkout} has no src/python/double_pendulum")
    if str(source) not in sys.path:
        sys.path.append(str(source))
    joint = ("first", "second").index(driven)
    parameters = importlib.import_module("double_pendulum.model.model_parameters").model_parameters(
        filepath=str(checkout / PARAMETERS)
    )
    limits = [0.0, 0.0]
    limits[joint] = LIMIT
    friction = list(parameters.cf)
    friction[1 - joint] *= 1.0 - compensated
    parameters.set_torque_limit(limits)
    parameters.set_cfric(friction)
    plant = importlib.import_module("double_pendulum.model.symbolic_plant").SymbolicDoublePendulum
    simulator = importlib.import_module("double_pendulum.simulation.simulation").Simulator
    return simulator(plant(torque_limit=limits, model_pars=parameters)), joint
