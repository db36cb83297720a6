"""Every number has a range, and what nobody can mean is refused before anything is done."""

import dataclasses
import time
from collections.abc import Iterator
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
import yaml
from shipped import shipped

import simbias
from simbias.config import ConfigError, options, sweeps
from simbias.config.components import component_class, constructor_parameters
from simbias.config.resources import resource_folder
from simbias.sweep.grid import expand
from simbias.testing.rehearsal import rehearse

GROUPS = [(group, option) for group, names in options().items() if group != "preset" for option in names]


def numbers(hint: Any, name: str) -> Iterator[tuple[str, set[str]]]:
    """The numbers in a type by name, and which bounds they have."""
    if get_origin(hint) is Annotated:
        inner, *metadata = get_args(hint)
        if inner in (int, float):
            each = [part for one in metadata for part in getattr(one, "metadata", [one])]
            yield name, {bound for bound in ("gt", "ge", "lt", "le") for part in each if hasattr(part, bound)}
        else:
            yield from numbers(inner, name)
    elif hint in (int, float):
        yield name, set()
    elif dataclasses.is_dataclass(hint):
        for field, own in get_type_hints(hint, include_extras=True).items():
            yield from numbers(own, f"{name}.{field}")
    else:
        for part in get_args(hint):
            yield from numbers(part, name)


def components() -> Iterator[tuple[str, type]]:
    """Every shipped component and figure."""
    for group, option in GROUPS:
        yield f"{group}={option}", component_class(shipped(group, option), group)
    for name in sweeps():
        sweep = yaml.safe_load((resource_folder("sweeps") / f"{name}.yaml").read_text()).get("sweep", {})
        for figure, spec in sweep.get("figures", {}).items():
            yield f"{name}: {figure}", component_class(spec, figure)


@pytest.mark.slow
def test_every_number_is_bounded_on_both_sides() -> None:
    found = 0
    for where, component in components():
        hints = get_type_hints(component.__init__, include_extras=True)  # type: ignore[misc]
        for parameter in constructor_parameters(component):
            for name, bounds in numbers(hints.get(parameter), parameter):
                found += 1
                assert bounds & {"gt", "ge"}, (where, name)
                assert bounds & {"lt", "le"}, (where, name)
    assert found > 100


@pytest.mark.slow
def test_an_experiment_in_which_nothing_can_fail_is_refused() -> None:
    """Every policy would succeed; so it would in a simulated rollout. Nor may a search stand still."""
    for override in ("task.time_step=1e-6", "task.horizon=9"):
        with pytest.raises(ConfigError, match=r"^task.*, too short for a failure; at least 0\.01 s"):
            rehearse(simbias.load([override, "tracking=none"]))
    with pytest.raises(ConfigError, match=r"^optimizer\.initial_deviation: "):  # CMA-ES could not begin
        simbias.load(["optimizer=cma", "optimizer.initial_deviation=5e-324", "tracking=none"])
    with pytest.raises(ConfigError, match=r"^evaluation\.seconds: must be greater than or equal to 0\.01"):
        simbias.load(["evaluation=domain_randomization_30s", "evaluation.seconds=1e-10", "tracking=none"])


@pytest.mark.slow
def test_a_sweep_that_is_too_large_is_refused_at_once() -> None:
    values = list(range(1, 400))
    axes = f"{{bias.d: {values}, hardware.iterations: {values}}}"
    began = time.process_time()
    for overrides in (
        ["+sweep=table2", "sweep.trials=5000"],
        ["+sweep=table2", f"sweep.trials={10**30}"],
        [f"+sweep={{trials: 1, axes: {axes}}}"],
    ):
        with pytest.raises(ConfigError, match=r"^sweep\.trials: .*100000"):
            expand([*overrides, "tracking=none"])
    assert time.process_time() - began < 5
