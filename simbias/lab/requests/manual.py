"""A person with a robot: requests in folders, answered by CSV files placed in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.core.records import Array, Rollout
from simbias.lab.requests.folder import README, TRAJECTORY, refuse_copied_file, write_request
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.requests.trajectory import read


@final
class Manual(Hardware):
    """Writes a request for each experiment, and waits for its `trajectory.csv`, for days if necessary.

    Parameters
    ----------
    requests
        The folder that contains one folder per request.
    """

    sets_start = False  # a person only comes close to it

    def __init__(self, task: Task, requests: str = "requests") -> None:
        self._task = task
        self._requests = Path(requests)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Write the request, or read the trajectory that answers it.

        Raises
        ------
        ConfigError
            If the trajectory is wrong; the message gives file, row and column in one line.
        HardwareError
            If the request cannot be written.
        Waiting
            If the trajectory is not there yet.
        """
        request = ExperimentRequest(self._task, policy, theta, start, int(rng.integers(2**62)))
        try:
            folder = write_request(request, self._requests)
        except OSError as error:
            raise HardwareError(
                f"{self._requests}: the request cannot be written ({words(error)})"
            ) from error
        file = folder / TRAJECTORY
        if not file.exists():
            raise Waiting(f"run the experiment of {folder / README}, and put its {TRAJECTORY} there")
        try:
            refuse_copied_file(file)
            return replace(read(file, request), source=str(file.resolve()))
        except HardwareError as error:  # bad input, not the robot's fault
            raise ConfigError(str(file), words(error).removeprefix(f"{file}: ")) from error
