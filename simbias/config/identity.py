"""Identity of a trial: all of its config that differs from constructors' defaults and affects its result.

A value that equals its constructor's default is left out. So an option that is added, its default the old
behaviour, changes the identity of no trial, nor its seed. A deliberate change of behaviour, as of a default,
raises the component's `version` instead: that gives all trials with this component new identities. Where one
value of an argument alone behaves otherwise, VERSIONS adds to the version of that value's trials. Arguments
that affect no result are in the component's `not_hashed`.
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

LATER = {  # groups that came later, and what does nothing in their place: earlier trials stay what they are
    "identification": {TARGET: "simbias.learning.identification.none.NoIdentification"},
    "budget": {"experiments": None, "seconds": None},
}
FORMER = {  # classes and arguments whose identities, and so whose seeds, come from an earlier name
    "ModelBased": "Algorithm1",  # which they are the same as, with the defaults
    "ModelBased.target_cost": "satisfactory_cost",
    "ModelBased.posterior_scale": "retry_spread",
    "ModelBased.model_selection": "by_evidence",
    "ModelBased.lqr_candidates": "design",
    "WindowGP": "HeldOut",
}
TOLD_BY_TEXT = PurePath, Enum, UUID, Decimal, date, time, timedelta, bytes, complex  # the same in any process
VERSIONS = {"DirectSearch.strategy=bayesian": 1}  # of one value of an argument, added to the class's


def identity_fields(
    config: Mapping[str, Any], left_out: Sequence[str], allowed: Sequence[str] = ()
) -> dict[str, Any]:
    """A trial's config, some groups left out, in plain containers.

    `allowed` and errors are as of `component_class` and `constructor_arguments`.
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
    """The class, its version beyond the first, and the arguments that are not its defaults."""
    component = component_class(config, key, allowed)
    provided = BESIDE.get(key, PROVIDED)
    arguments = constructor_arguments(component, config, key, provided)
    defaults = {
        name: parameter.default
        for name, parameter in constructor_parameters(component).items()
        if parameter.default is not parameter.empty
    }
    own = component.__module__.partition(".")[0] == __name__.partition(".")[0]  # whose files may move
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
    """The values that are not the defaults, as plain containers."""
    plain = {name: _plain(value, f"{key}.{name}") for name, value in values.items()}
    return {
        name: value for name, value in plain.items() if name not in defaults or not _is(value, defaults[name])
    }


def _is(plain: Any, default: Any) -> bool:
    """Whether a plain value is that of a default, which may be of any type, as a function."""
    try:
        return bool(plain == _plain(default, ""))
    except ConfigError:
        return False


def _plain(value: Any, key: str) -> Any:
    """A value as plain containers; of a dataclass, what deviates from its defaults.

    A ConfigError names the key of a value of another type, whose text may differ between processes.
    """
    if is_dataclass(value) and not isinstance(value, type):
        defaults = {
            each.name: each.default if each.default_factory is MISSING else each.default_factory()
            for each in fields(value)
            if each.default is not MISSING or each.default_factory is not MISSING
        }
        return _deviations(vars(value), defaults, key)
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
    raise ConfigError(key, f"{expected}, of which a trial's identity is made, got {type(value).__name__}")
