"""Whether a study fits into this machine's memory: told before it is taken."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.trial.study import Study

BYTES = 8  # of a number
GIB = 2**30
CONTAINER = Path("/sys/fs/cgroup/memory.max")  # where Linux says what a container may take


def check_memory(study: Study) -> None:
    """Refuse a study whose rollouts alone cannot fit.

    Raises
    ------
    ConfigError
        Naming the horizon.
    """
    needed, there = needed_bytes(study), machine_bytes()
    if there is not None and needed > there:
        rollouts = study.evaluation.noisy_rollouts
        noise = f" and the noise of {rollouts} rollouts" if rollouts else ""
        problem = (
            f"{study.task.horizon} frames of an experiment{noise} take at least {needed / GIB:.0f} GiB of "
            f"memory, this machine has {there / GIB:.0f} GiB"
        )
        raise ConfigError("task.horizon", problem)


def needed_bytes(study: Study) -> int:
    """What a trial takes at least: a recorded experiment, and the noise of a search, which is joined once."""
    task = study.task
    width = len(task.states) + len(task.inputs)
    noise = 2 * study.evaluation.noisy_rollouts * ((study.evaluation.horizon or task.horizon) + 1)
    return BYTES * width * (task.horizon + 1 + noise)


def machine_bytes() -> int | None:
    """The memory of this machine or container, if the system tells."""
    known = []
    with suppress(AttributeError, ValueError, OSError):  # Windows, or a system that does not say
        known.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(ValueError, OSError):  # not in a container, or one without a limit
        known.append(int(CONTAINER.read_text()))
    return min(known, default=None)
