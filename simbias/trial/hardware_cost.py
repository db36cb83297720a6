"""The cost of a policy on a simulated hardware, for searches that spend no experiments."""

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

SCREENING = 2  # rollouts after which a policy that failed in all of them is not tried any further


def check_simulator(hardware: Hardware, key: str = "method") -> None:
    """Refuse a hardware that is a person's, a program's or a recording, by a ConfigError on the key."""
    if type(hardware).__module__.startswith("simbias.lab"):
        problem = f"searches on the hardware itself, but {type(hardware).__name__} is no simulator"
        raise ConfigError(key, problem)


def cost_on_hardware(
    study: Study, hardware: Hardware, rng: np.random.Generator, rollouts: int
) -> Callable[[Array], float]:
    """The mean cost Z (Eq. 8) of a policy over some starts and noise, drawn once, the same for every policy.

    The hardware is a simulator: it is run as often as a search asks, under the study's conditions. Nobody is
    asked about one of simbias's, which moves nothing; one of the user's own may be a robot, as may be what is
    behind an environment that is not Gymnasium's. A policy that fails from the first starts costs the mean
    of these. Errors as of `check_simulator`.
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
