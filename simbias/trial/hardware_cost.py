"""The cost of a policy on simulated hardware, for searches that spend no experiments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from simbias.core import Hardware
from simbias.core.error_origin import is_own
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.lab.checked_hardware import CheckedHardware
from simbias.trial.study import Study

SCREENING = 2  # rollouts; a policy that fails in all of them is not evaluated further


def check_simulator(hardware: Hardware, key: str = "method") -> None:
    """Raise ConfigError on the key if the hardware is a person, a program or a recording."""
    if type(hardware).__module__.startswith("simbias.lab"):
        problem = f"searches on the hardware itself, but {type(hardware).__name__} is not a simulator"
        raise ConfigError(key, problem)


def cost_on_hardware(
    study: Study, hardware: Hardware, rng: np.random.Generator, rollouts: int
) -> Callable[[Array], float]:
    """The mean cost Z (Eq. 8) of a policy over starts and noise that are drawn once for all policies.

    The hardware is a simulator: it runs as often as the search requires, under the study's conditions.
    simbias's own simulators move nothing, so they need no confirmation; custom hardware, or an environment
    that is not Gymnasium's, may be a robot. A policy that fails from the first starts costs their mean.
    Errors as for `check_simulator`.
    """
    check_simulator(hardware)
    robot = is_own(hardware) or not getattr(hardware, "simulates", True)
    conditions = replace(study.conditions, confirm=study.conditions.confirm and robot)
    checked = CheckedHardware(hardware, study.task, conditions)
    scenarios = [(study.task.draw_start(each), int(each.integers(2**62))) for each in rng.spawn(rollouts)]

    def cost(theta: Array) -> float:
        costs: list[float] = []
        for start, seed in scenarios:
            if len(costs) == SCREENING and min(costs) > study.cost.max_cost:
                break
            rollout = checked.run(study.policy, theta, start, np.random.default_rng(seed))
            costs.append(study.cost.of(rollout))
        return float(np.mean(costs))

    return cost
