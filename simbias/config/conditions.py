"""Keys of every hardware in addition to its constructor's: the conditions of its experiments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NotRequired

from simbias.config.components import validate
from simbias.core import Task
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.lab.checked_hardware import ExperimentConditions
from simbias.lab.safety import NO_LIMITS, Safety

HARDWARE = "hardware"  # the group
FIELDS = {"safety": NotRequired[Safety], "confirm": NotRequired[bool]}


def split(config: Any) -> tuple[Any, dict[str, Any]]:
    """Split a hardware's config into the rest and these keys."""
    if not isinstance(config, Mapping):
        return config, {}
    own = {key: value for key, value in config.items() if key not in FIELDS}
    return own, {key: value for key, value in config.items() if key in FIELDS}


def safety(config: Any) -> Safety:
    """The limits of a hardware's config; a ConfigError if a value has the wrong type or range."""
    _, own = split(config)
    found: Safety = validate(own, FIELDS, HARDWARE).get("safety", NO_LIMITS) if own else NO_LIMITS
    return found


def conditions(config: Any, task: Task, timeout: float | None) -> ExperimentConditions:
    """The conditions in a hardware's config; errors as for `safety`, also for unknown quantities."""
    values = ExperimentConditions(timeout, **validate(split(config)[1], FIELDS, HARDWARE))
    try:
        values.safety.bounds(task.without_targets)
    except ValueError as error:
        raise ConfigError(f"{HARDWARE}.safety", words(error)) from error
    return values
