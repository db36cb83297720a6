"""From a composition to a study."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NotRequired, Required, get_type_hints

import numpy as np
from pydantic import PositiveFloat

from simbias.config.allowed import Own
from simbias.config.components import BESIDE, PROVIDED, construct, validate
from simbias.config.composition import OF_SWEEPS, Composition
from simbias.config.conditions import HARDWARE, conditions, split
from simbias.config.identity import LATER
from simbias.config.renamed import unknown
from simbias.core import Criterion, Hardware, Nominal, Push, Quantity, StudyWarning, Task
from simbias.core.errors import ConfigError
from simbias.core.messages import quote, words
from simbias.core.ranges import Seed
from simbias.core.records import Array
from simbias.core.task_checks import check_quantities, check_starts
from simbias.trial.budget import Budget
from simbias.trial.origin import model_digest
from simbias.trial.policy_test import PolicyTest
from simbias.trial.study import Study

NO_COMPONENTS = (
    *("seed", "conditions", "policy_test", "budget", "spending", "composed"),
    *("composition", "hardware_of", "nominal_of"),
)
VALUES = {
    "seed": Required[Seed],
    "experiment_timeout": NotRequired[PositiveFloat | None],
    "policy_test": NotRequired[PolicyTest],
    "budget": NotRequired[Budget],
}
OF_ROBOTS = ("hardware", "identification", "samples", "bias")  # groups built without a task's targets
BESIDE_STUDIES = ("tracking", *OF_SWEEPS)  # groups without a component in a study
CONTRACTS = {k: v for k, v in get_type_hints(Study).items() if k not in NO_COMPONENTS}
OF_RECORDINGS = ("task", "nominal", "hardware", "identification")
NOT_OF_RECORDINGS = tuple(group for group in CONTRACTS if group not in OF_RECORDINGS)


def build(composition: Composition, left_out: Sequence[str] = ()) -> Study:
    """Construct the components of a study; those of groups that are `left_out` are None.

    Raises
    ------
    ConfigError
        If a key is unknown or missing, a value has the wrong type or range, or a constructor refuses.
    """
    composition = composition.trial
    config = {**LATER, **composition.config}
    for key in config:
        if key not in CONTRACTS and key not in (*VALUES, *BESIDE_STUDIES):
            keys = [f"{key}.{each}" for each in config[key]] if isinstance(config[key], Mapping) else []
            problem = f"no such group; available: {', '.join([*CONTRACTS, *BESIDE_STUDIES])}"
            if key == "preset":
                problem = "its file must begin with the line '# @package _global_'"
            raise unknown([*keys, key], key, problem)
    for key in (*CONTRACTS, "seed"):
        if key not in config and key not in left_out:
            raise ConfigError(key, "missing")
    values = validate({key: config[key] for key in VALUES if key in config}, VALUES, "")
    timeout = values.pop("experiment_timeout", None)
    own = composition.own
    task = build_task(config["task"], own)
    config[HARDWARE], _ = split(whole := config[HARDWARE])
    nominal = _nominal(config["nominal"], own, task)
    given = {"task": task, "nominal": nominal, "hardware_from": partial(_hardware, own=own, task=task)}
    of_robot = {**given, "task": task.without_targets}
    components: dict[str, Any] = {}
    for group, contract in CONTRACTS.items():
        if group not in given:
            beside = of_robot if group in OF_ROBOTS else given
            arguments = {key: beside[key] for key in BESIDE.get(group, PROVIDED)}
            left = group in left_out
            components[group] = None if left else construct(config[group], contract, group, own, **arguments)
    study = Study(
        task=task,
        nominal=nominal,
        **components,
        **values,
        composition=composition,
        hardware_of=partial(_hardware, config[HARDWARE], own),
        nominal_of=partial(_nominal, config["nominal"], own),
        conditions=conditions(whole, task, timeout),
    )
    study.composed.extend(study.components)
    _check_known(study, config["identification"].get("known"))
    return study


def _check_known(study: Study, known: Any) -> None:
    """Refuse a posterior of a nominal model other than the study's; warn of one that is doubted."""
    if isinstance(known, Mapping) and known.get("model") not in (None, model_digest(study)):
        problem = (
            "belongs to a nominal model with other values or files; identify again, or leave out its `model`"
        )
        raise ConfigError("identification.known", problem)
    if isinstance(known, Mapping) and known.get("doubts") and all(known["doubts"]):
        words = "the identification begins with a posterior of which no parameter is trusted"
        warnings.warn(words, StudyWarning, stacklevel=4)


def build_task(config: Any, own: Own) -> Task:
    """A task from its config; errors as for `construct`, also for attributes of wrong type or shape."""
    task: Task = construct(config, Task, "task", own)
    try:
        _convert(task)
        check_quantities(task)
        check_starts(task)
    except Exception as error:  # a custom class may lack them, or its properties may raise
        raise ConfigError("task", words(error)) from error
    return task


def _convert(task: Task) -> None:
    """Convert a task's sequences to tuples and float arrays, as authors may write lists and integers.

    Attributes that cannot be set, such as properties, stay unchanged. A ValueError names invalid ones.
    """

    def keep(name: str, expected: str, convert: Callable[[Any], Any]) -> None:
        given = getattr(task, name)
        try:
            converted = convert(given)
        except (TypeError, ValueError) as error:
            problem = f"{type(task).__name__}.{name}: expected {expected}, got {quote(given)}"
            raise ValueError(problem) from error
        if converted is not given:
            with suppress(AttributeError):
                setattr(task, name, converted)

    kinds = dict.fromkeys(("states", "targets", "inputs", "outputs"), Quantity)
    for name, kind in {**kinds, "criteria": Criterion, "pushes": Push}.items():
        keep(name, f"a tuple of {kind.__name__}", partial(_tuple, kind))
    vectors = {"input_limit": task.inputs, "start_mean": task.states, "start_deviation": task.states}
    for name, parts in vectors.items():
        keep(name, f"numbers of the shape ({len(parts)},)", partial(_numbers, len(parts)))


def _tuple(kind: type, given: Any) -> tuple[Any, ...]:
    """A list or tuple of one kind as a tuple."""
    if not isinstance(given, list | tuple) or not all(isinstance(each, kind) for each in given):
        raise TypeError
    return tuple(given)


def _numbers(count: int, given: Any) -> Array:
    """Numbers as an array (count,) of floats."""
    array = np.asarray(given, dtype=np.float64)
    if array.shape != (count,):
        raise ValueError
    return array


def service(composition: Composition, group: str, contract: type) -> Any:
    """Construct a service for studies, such as an engine or a store of trials; errors as for `build`."""
    if group not in composition.config:
        raise ConfigError(group, "missing")
    return construct(composition.config[group], contract, group, composition.own)


def _nominal(config: Any, own: Own, task: Task) -> Nominal:
    """The nominal model for a task; errors as for `construct`."""
    nominal: Nominal = construct(config, Nominal, "nominal", own, task=task.without_targets)
    return nominal


def _hardware(config: Any, own: Own, task: Task) -> Hardware:
    """The hardware for a task; errors as for `construct`."""
    hardware: Hardware = construct(config, Hardware, HARDWARE, own, task=task.without_targets)
    return hardware
