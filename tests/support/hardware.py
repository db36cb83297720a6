"""Hardware of a study wrapped, for tests of trials."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from simbias.core import Hardware, Policy, Waiting
from simbias.core.records import Array, Rollout
from simbias.trial.study import Study


class Doing(Hardware):
    """What another hardware does, and then something else."""

    def __init__(self, hardware: Hardware, fault: Callable[[Rollout], Any]) -> None:
        self._hardware, self._fault = hardware, fault

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Any:
        return self._fault(self._hardware.run(policy, theta, start, rng))


class Counted(Hardware):
    """Notes the experiments that are made in a log; if slow, has each result when it is asked for again."""

    def __init__(self, hardware: Hardware, log: list[str], slow: bool) -> None:
        self._hardware, self._log, self._slow = hardware, log, slow

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        self._log.append("asked")
        if self._slow and self._log.count("asked") % 2:
            raise Waiting("trajectory.csv is not there yet.")
        self._log.append("made")
        return self._hardware.run(policy, theta, start, rng)


def counted(study: Study, slow: bool = False) -> tuple[Study, list[str]]:
    """The study with such a hardware, also for test episodes, and its log."""
    log: list[str] = []
    same = replace(
        study,
        hardware=Counted(study.hardware, log, slow),
        hardware_of=lambda task: Counted(study.hardware_of(task), log, slow),
    )
    return same, log
