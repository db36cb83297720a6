"""Identity of a trial: the part of its config that deviates from defaults and affects its result.

A value that equals its constructor's default is left out. A new option whose default is the old behaviour
thus changes neither the identity nor the seed of any trial. A deliberate change of behaviour, such as of a
default, increments the component's `version` instead, which gives all trials with this component new
identities. If only one value of an argument changes its behaviour, VERSIONS adds to the version for that
value's trials. Arguments that do not affect results are listed in the component's `not_hashed`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import MISSING, fields, is_dataclass
from datetime import date, time, timedelta
from decimal import Decimal
from enum import Enum
from pathlib import PurePath
from typing import Any
from uuid import UUID

import numpy as np

from simbias.config.allowed import TARGET
from simbias.config.components import (
    BESIDE,
    PROVIDED,
    component_class,
    constructor_arguments,
    constructor_parameters,
    validate,
)
from simbias.config.conditions import HARDWARE, safety, split
from simbias.core.errors import ConfigError
from simbias.trial.budget import Budget

LATER = {  # later groups, and their neutral options, so that earlier trials keep their identity
    "identification": {TARGET: "simbias.learning.identification.none.NoIdentification"},
    "budget": {"experiments": None, "seconds": None},
}
FORMER = {  # classes and arguments whose identities, and so whose seeds, come from an earlier name
    "ModelBased": "Algorithm1",  # same behaviour with the defaults
    "ModelBased.target_cost": "satisfactory_cost",
    "ModelBased.posterior_scale": "retry_spread",
    "ModelBased.model_selection": "by_evidence",
    "ModelBased.lqr_candidates": "design",
    "WindowGP": "HeldOut",
}
TOLD_BY_TEXT = PurePath, Enum, UUID, Decimal, date, time, timedelta, bytes, complex  # process-independent
VERSIONS = {"DirectSearch.strategy=bayesian": 1}  # for one value of an argument, added to the class's version


def identity_fields(
    config: Mapping[str, Any], left_out: Sequence[str], allowed: Sequence[str] = ()
) -> dict[str, Any]:
    """A trial's config without some groups, in plain containers.

    `allowed` and errors are as for `component_class` and `constructor_arguments`.
    """
    relevant = {
        key: value for key, value in config.items() if key not in left_out and value != LATER.get(key)
    }
    if "budget" in relevant:  # 10 s are 10.0 s
        budget = validate({"budget": relevant["budget"]}, {"budget": Budget}, "")["budget"]
        relevant["budget"] = vars(budget)
    limits = safety(relevant.get(HARDWARE, {}))
    if HARDWARE in relevant:
        relevant[HARDWARE], _ = split(relevant[HARDWARE])
    found = {
        key: _component(value, key, allowed) if isinstance(value, Mapping) and TARGET in value else value
        for key, value in relevant.items()
    }
    return {**found, "safety": _plain(limits, f"{HARDWARE}.safety")} if limits.limits else found


def _component(config: Mapping[str, Any], key: str, allowed: Sequence[str]) -> dict[str, Any]:
    """The class, its version if not the first, and its non-default arguments."""
    component = component_class(config, key, allowed)
    provided = BESIDE.get(key, PROVIDED)
    arguments = constructor_arguments(component, config, key, provided)
    defaults = {
        name: parameter.default
        for name, parameter in constructor_parameters(component).items()
        if parameter.default is not parameter.empty
    }
    own = component.__module__.partition(".")[0] == __name__.partition(".")[0]  # simbias's files may move
    name = component.__name__ if own else f"{component.__module__}.{component.__qualname__}"
    changes = [VERSIONS.get(f"{name}.{argument}={value}", 0) for argument, value in arguments.items()]
    version = getattr(component, "version", 1) + sum(changes)
    not_hashed = getattr(component, "not_hashed", ())
    hashed = {name: value for name, value in arguments.items() if name not in not_hashed}
    deviations = _deviations(hashed, defaults, key).items()
    return {
        "class": FORMER.get(name, name),
        **({"version": version} if version != 1 else {}),
        **{FORMER.get(f"{name}.{argument}", argument): value for argument, value in deviations},
    }


def _deviations(values: Mapping[str, Any], defaults: Mapping[str, Any], key: str) -> dict[str, Any]:
    """The non-default values, as plain containers."""
    plain = {name: _plain(value, f"{key}.{name}") for name, value in values.items()}
    return {
        name: value for name, value in plain.items() if name not in defaults or not _is(value, defaults[name])
    }


def _is(plain: Any, default: Any) -> bool:
    """Whether a plain value equals a default, which may be of any type, such as a function."""
    try:
        return bool(plain == _plain(default, ""))
    except ConfigError:
        return False


def _plain(value: Any, key: str) -> Any:
    """A value as plain containers; for a dataclass, its non-default fields that are compared.

    A ConfigError names the key of a value of another type, whose text may differ between processes.
    """
    if is_dataclass(value) and not isinstance(value, type):
        compared = [each for each in fields(value) if each.compare]
        defaults = {
            each.name: each.default if each.default_factory is MISSING else each.default_factory()
            for each in compared
            if each.default is not MISSING or each.default_factory is not MISSING
        }
        return _deviations({each.name: getattr(value, each.name) for each in compared}, defaults, key)
    if isinstance(value, Mapping):
        return {str(name): _plain(each, key) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each, key) for each in value]
    if isinstance(value, Set):
        return sorted((_plain(each, key) for each in value), key=repr)
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), key)
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, TOLD_BY_TEXT):
        return str(value)
    expected = "expected numbers, texts, times, paths, arrays, containers or dataclasses"
    raise ConfigError(key, f"{expected}, which make up a trial's identity, got {type(value).__name__}")
