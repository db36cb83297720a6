"""A hardware that notes in a file of the working folder every experiment that is really begun."""

import json
import time
from pathlib import Path

import numpy as np

from simbias.core import Hardware, Policy, Task
from simbias.core.records import Array, Rollout
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

LOG = "experiments.log"


class Logged(Hardware):
    """The simulated robot, as slow as a kill needs it to be to fall into an experiment."""

    def __init__(self, task: Task, seconds: float = 0.2) -> None:
        self._robot = PymunkBongoboard(task)  # type: ignore[arg-type]
        self._seconds = seconds

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        with Path(LOG).open("a") as file:
            file.write(json.dumps(start.tolist()) + "\n")
        time.sleep(self._seconds)
        return self._robot.run(policy, theta, start, rng)
