"""From a plain config to components: every argument is checked against its constructor's annotation."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any, NotRequired, Required, get_type_hints

from pydantic import ConfigDict, NonNegativeInt, TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic takes only this one before Python 3.12

from simbias.config.composition import Composition, ConfigError
from simbias.interfaces import Engine, Task
from simbias.study import Study

NO_COMPONENTS = ("seed", "composition")


def build(composition: Composition) -> Study:
    """Construct the components of a study.

    Raises
    ------
    ConfigError
        If a key is unknown or missing, a value has the wrong type or range, or a constructor refuses.
    """
    engine(composition)
    composition = composition.trial
    config = composition.config
    contracts = {k: v for k, v in get_type_hints(Study).items() if k not in NO_COMPONENTS}
    for key in config:
        if key not in contracts and key not in NO_COMPONENTS:
            raise ConfigError(key, f"no such group; there are {', '.join(contracts)}")
    for key in (*contracts, "seed"):
        if key not in config:
            raise ConfigError(key, "missing")
    seed = validated({"seed": config["seed"]}, {"seed": Required[NonNegativeInt]}, "")["seed"]
    task = construct(config["task"], Task, "task")
    components = {
        group: construct(config[group], contract, group, task=task)
        for group, contract in contracts.items()
        if group != "task"
    }
    return Study(task=task, **components, seed=seed, composition=composition)


def engine(composition: Composition) -> Engine | None:
    """Construct where a sweep's trials run; None where that is not said, as inside a worker.

    Raises
    ------
    ConfigError
        As `build` does.
    """
    config = composition.config.get("engine")
    return None if config is None else construct(config, Engine, "engine")


def construct(config: Any, contract: type, key: str, **provided: Any) -> Any:
    """Construct what `_target_` names; `provided` are arguments that it gets if it has them.

    Raises
    ------
    ConfigError
        Naming `key` and the argument.
    """
    if not isinstance(config, Mapping) or "_target_" not in config:
        raise ConfigError(key, f"must be a mapping with a _target_, got {config!r}")
    component = _locate(config["_target_"], f"{key}._target_")
    if not (inspect.isclass(component) and issubclass(component, contract)):
        raise ConfigError(f"{key}._target_", f"{config['_target_']} is not a {contract.__name__}")
    fields = _fields(component)
    given = {name: value for name, value in config.items() if name != "_target_"}
    for name in provided:
        if name in given:
            raise ConfigError(f"{key}.{name}", "is provided, not configured")
    arguments = validated(given, {k: v for k, v in fields.items() if k not in provided}, key)
    try:
        return component(**arguments, **{k: v for k, v in provided.items() if k in fields})
    except Exception as error:
        raise ConfigError(key, " ".join(str(error).split()) or type(error).__name__) from error


def _locate(target: Any, key: str) -> Any:
    """The class at a dotted path."""
    module_name, _, name = str(target).rpartition(".")
    try:
        return getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(key, f"cannot import {target!r} ({error})") from error


def _fields(component: type) -> dict[str, Any]:
    """The constructor's arguments as fields of a typed dictionary."""
    hints = get_type_hints(component.__init__, include_extras=True)  # type: ignore[misc]
    parameters = inspect.signature(component).parameters.values()
    return {
        p.name: (Required if p.default is p.empty else NotRequired)[hints.get(p.name, Any)]
        for p in parameters
    }


def validated(values: Mapping[str, Any], fields: dict[str, Any], key: str) -> dict[str, Any]:
    """The values converted to the fields' types."""
    schema = TypedDict("schema", fields)  # type: ignore[misc]
    schema.__pydantic_config__ = ConfigDict(  # type: ignore[attr-defined]
        extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False
    )
    try:
        return dict(TypeAdapter(schema).validate_python(values))
    except ValidationError as error:
        raise _in_one_line(error, key) from error


def _in_one_line(error: ValidationError, key: str) -> ConfigError:
    """The first of pydantic's errors, as one line that names the key."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in ((key,) if key else ()) + first["loc"])
    if first["type"] == "extra_forbidden":
        return ConfigError(where, "no such key")
    if first["type"] == "missing":
        return ConfigError(where, "missing")
    problem = first["msg"].removeprefix("Input ").removeprefix("List ").replace("should", "must", 1)
    return ConfigError(where, f"{problem}, got {first['input']!r}")
