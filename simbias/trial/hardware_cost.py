"""The cost of a policy on a simulated hardware, for searches that spend no experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simbias.core import Hardware
from simbias.core.error_origin import is_own
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.lab.checked_hardware import CheckedHardware
from simbias.trial.study import Study

SCREENING = 2  # rollouts after which a policy that failed in all of them is not tried any further


def check_simulator(hardware: Hardware, key: str = "method") -> None:
    """Refuse a hardware that is a person's, a program's or a recording.

    Raises
    ------
    ConfigError
        Naming the key.
    """
    if type(hardware).__module__.startswith("simbias.lab"):
        problem = f"searches on the hardware itself, but {type(hardware).__name__} is no simulator"
        raise ConfigError(key, problem)


class CostOnHardware:
    """The mean cost Z (Eq. 8) of a policy over some starts and noise, drawn once, the same for every policy.

    The hardware is a simulator: it is run as often as a search asks, under the study's conditions. Nobody is
    asked about one of simbias's, which moves nothing; one of the user's own may be a robot, as may be what is
    behind an environment that is not Gymnasium's.

    Raises
    ------
    ConfigError
        As of `check_simulator`.
    """

    def __init__(self, study: Study, hardware: Hardware, rng: np.random.Generator, rollouts: int) -> None:
        check_simulator(hardware)
        robot = is_own(hardware) or not getattr(hardware, "simulates", True)
        conditions = replace(study.conditions, confirm=study.conditions.confirm and robot)
        self._study, self._hardware = study, CheckedHardware(hardware, study.task, conditions)
        self._scenarios = [
            (study.task.draw_start(each), int(each.integers(2**62))) for each in rng.spawn(rollouts)
        ]

    def __call__(self, theta: Array) -> float:
        """The mean cost of theta (p,); of one that fails from the first starts, that from these."""
        costs: list[float] = []
        for start, seed in self._scenarios:
            if len(costs) == SCREENING and min(costs) > self._study.cost.max_cost:
                break
            rng = np.random.default_rng(seed)
            rollout = self._hardware.run(self._study.policy, theta, start, rng)
            costs.append(self._study.cost.of(rollout))
        return float(np.mean(costs))
