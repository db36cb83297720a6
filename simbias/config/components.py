"""A component from its config: every argument is checked against its constructor's annotation."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any, NotRequired, Required, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic accepts only this one before Python 3.12

from simbias.config.allowed import NOTHING, TARGET, Own, check_allowed
from simbias.config.renamed import unknown
from simbias.core import Task
from simbias.core.errors import ConfigError, reason
from simbias.core.files import FOLDERS
from simbias.core.messages import quote, with_type, words

TYPOS = ("extra_forbidden", "unexpected_keyword_argument")  # pydantic's words for an unknown key
ALTERNATIVE = re.compile(r"(list|dict)\[.+\]|constrained-\w+")  # names of type alternatives, not keys
NEAR = 0.8  # difflib's ratio from which a key is taken for a typo of another

PROVIDED = frozenset({"task", "hardware_from"})  # arguments of constructors in addition to their config,
BESIDE = {"task": frozenset[str](), "policy": PROVIDED | {"nominal"}}  # for these groups


def construct(config: Any, contract: type, key: str, own: Own = NOTHING, **provided: Any) -> Any:
    """Construct the class in `_target_`; it gets those `provided` arguments that it accepts.

    Its module must be simbias's or in `own.modules`; files are looked up in `own.folders`. A ConfigError
    names `key` and the argument, also if the constructor raises.
    """
    component = component_class(config, key, own.modules)
    if not issubclass(component, contract):
        raise ConfigError(f"{key}.{TARGET}", f"{config[TARGET]} is not a {contract.__name__.lower()}")
    parameters = constructor_parameters(component)
    for name in provided:
        if name in config:
            raise ConfigError(f"{key}.{name}", "is provided by simbias, so it cannot be set")
    arguments = constructor_arguments(component, config, key, frozenset(provided), own.folders)
    given = {name: value for name, value in provided.items() if name in parameters}
    hints = _hints(component)
    for name, value in given.items():
        if (
            inspect.isclass(kind := hints.get(name))
            and issubclass(kind, Task)
            and not isinstance(value, kind)
        ):
            raise ConfigError(key, f"{component.__name__} works with a task of {kind.__name__} only")
    try:
        return component(**arguments, **given)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # also SystemExit, and what other libraries raise to end tasks
        raise ConfigError(key, words(error)) from error


def component_class(config: Any, key: str, allowed: Sequence[str] = ()) -> Any:
    """The class that `_target_` names; a ConfigError if there is none, or its module may not be imported."""
    if not isinstance(config, Mapping) or TARGET not in config:
        chosen = f"; a file's defaults choose an option: 'override /{key}: {config}'"
        chosen *= isinstance(config, str)
        raise ConfigError(key, f"must be a mapping with a {TARGET}, got {quote(config)}{chosen}")
    target = config[TARGET]
    module_name, _, name = str(target).rpartition(".")
    if not module_name:
        raise ConfigError(f"{key}.{TARGET}", f"must be module.Class, got {quote(target)}")
    check_allowed(module_name, f"{key}.{TARGET}", allowed)
    try:
        component = getattr(importlib.import_module(module_name), name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a custom module may raise anything, or exit
        kind = "" if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: "
        raise ConfigError(
            f"{key}.{TARGET}", f"cannot import {quote(target)} ({kind}{words(error)})"
        ) from error
    if not inspect.isclass(component):
        raise ConfigError(f"{key}.{TARGET}", f"{target} is not a class")
    return component


def constructor_arguments(
    component: Any,
    config: Mapping[str, Any],
    key: str,
    provided: frozenset[str] = frozenset(),
    folders: Sequence[str] = (),
) -> dict[str, Any]:
    """The config's values, converted to the types of the constructor's annotations.

    Relative file names are resolved in the folders of configs if they exist there. Errors as for `validate`;
    also if a constructor does not name all its arguments.
    """
    parameters = constructor_parameters(component)
    for parameter in parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            problem = f"{component.__name__}'s constructor takes {parameter}; it must name its options"
            raise ConfigError(key, problem)
    given = {name: value for name, value in config.items() if name != TARGET}
    try:
        schema = _schema(component, provided)
    except Exception as error:  # for example, annotations imported only for type checkers
        problem = f"the annotations of {component.__name__}'s constructor cannot be read ({with_type(error)})"
        raise ConfigError(key, problem) from error
    return _converted(given, schema, key, parameters, folders)


@cache
def constructor_parameters(component: Any) -> Mapping[str, inspect.Parameter]:
    """The constructor's parameters by name."""
    return inspect.signature(component).parameters


@cache
def _schema(component: Any, provided: frozenset[str]) -> TypeAdapter:
    """The schema of a constructor's arguments, except provided ones."""
    hints = _hints(component)
    fields = {
        name: (Required if parameter.default is parameter.empty else NotRequired)[hints.get(name, Any)]
        for name, parameter in constructor_parameters(component).items()
        if name not in provided
    }
    return _adapter(fields)


@cache
def _hints(component: Any) -> Mapping[str, Any]:
    """The annotations of a constructor's arguments."""
    fields = dataclasses.fields(component) if dataclasses.is_dataclass(component) else ()
    generated = bool(fields) and constructor_parameters(component).keys() <= {field.name for field in fields}
    try:  # inherited fields may name what only another module imports
        return get_type_hints(component if generated else component.__init__, include_extras=True)
    except NameError:  # perhaps of an attribute that is no parameter
        return get_type_hints(component.__init__, include_extras=True)


def _adapter(fields: dict[str, Any]) -> TypeAdapter:
    """The schema of a mapping with these fields."""
    schema = TypedDict("schema", fields)  # type: ignore[misc]
    schema.__pydantic_config__ = ConfigDict(  # type: ignore[attr-defined]
        extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False
    )
    return TypeAdapter(schema)


@cache
def _own_adapter(fields: tuple[tuple[str, Any], ...]) -> TypeAdapter:
    """The cached schema of our own fields; making one takes longer than using it."""
    return _adapter(dict(fields))


def validate(values: Mapping[str, Any], fields: dict[str, Any], key: str) -> dict[str, Any]:
    """The values converted to the fields' types, or a ConfigError that names `key` and the field."""
    return _converted(values, _own_adapter(tuple(fields.items())), key, fields)


def _converted(
    values: Mapping[str, Any],
    adapter: TypeAdapter,
    key: str,
    known: Collection[str],
    folders: Sequence[str] = (),
) -> dict[str, Any]:
    """The values converted by the adapter; `known` are valid names."""
    try:
        converted = dict(adapter.validate_python(values, context={FOLDERS: folders}))
    except ValidationError as error:
        raise _in_one_line(error, key, known) from error
    except Exception as error:  # a system error, if a path cannot even be queried
        raise ConfigError(key, reason(error)) from error
    _check_numbers(values, converted, key)
    return converted


def _check_numbers(given: Any, converted: Any, key: str) -> None:
    """Refuse true and false where a number is expected, since pydantic reads them as 1 and 0."""
    if isinstance(given, bool) and isinstance(converted, float | int) and not isinstance(converted, bool):
        raise ConfigError(key, f"must be a number, got {str(given).lower()}")
    if isinstance(given, Mapping):
        if isinstance(converted, tuple):  # named, or of items in order
            converted = converted._asdict() if hasattr(converted, "_asdict") else dict(converted)
        parts = converted if isinstance(converted, Mapping) else getattr(converted, "__dict__", {})
        for name in (name for name in given if name in parts):
            _check_numbers(given[name], parts[name], f"{key}.{name}".lstrip("."))
    elif isinstance(given, list) and isinstance(converted, list | tuple):
        for index, pair in enumerate(zip(given, converted, strict=False)):
            _check_numbers(*pair, f"{key}.{index}")


def _path(key: str, error: Mapping[str, Any]) -> str:
    """The full name of the key in pydantic's error."""
    names = (str(part) for part in error["loc"])
    return ".".join([key] * bool(key) + [name for name in names if not ALTERNATIVE.fullmatch(name)])


def _in_one_line(error: ValidationError, key: str, known: Collection[str]) -> ConfigError:
    """The first of pydantic's errors in one line that names the key and, for a typo, the intended name."""
    errors = error.errors(include_url=False)
    of_one = [each for each in errors if each["loc"][:1] == errors[0]["loc"][:1]]
    deepest = max(of_one, key=lambda each: len(each["loc"]))  # the error of the intended alternative
    first = next((each for each in errors if each["type"] in TYPOS), deepest)
    typos = [_path(key, each) for each in errors if each["type"] in TYPOS]
    where = _path(key, first)
    if first["type"] in TYPOS:
        hint = ""
        if ")" in where:  # `{value: max(a, b)}` of YAML is a key `value` and a key `b)`
            hint = "; put an expression with commas in quotes"
        elif near := get_close_matches(where.removeprefix(f"{key}."), known, 1, NEAR):
            hint = f"; did you mean {near[0]}?"
        elif where.count(".") == 1:  # for a component that replaced a preset's
            it, leaves = ("it", "leaves") if len(typos) == 1 else ("them", "leave")
            hint = f"; if a preset sets {it}, {' '.join(f'~{each}' for each in typos)} {leaves} {it} out"
        return unknown([where], where, f"no such key{hint}")
    if first["type"] == "missing":
        return ConfigError(where, "missing")
    if first["loc"][-1] == "[key]" and not isinstance(first["input"], str):
        problem = (
            f"{first['input']} is not a name; put it in quotes (YAML reads on and off as true and false)"
        )
        return ConfigError(_path(key, {"loc": first["loc"][:-2]}), problem)
    problem = re.sub("^(Value error, |Input |List )", "", first["msg"]).replace("should", "must", 1)
    return ConfigError(where, f"{problem}, got {quote(first['input'])}")
