"""Every number has a range, and what nobody can mean is refused before anything is done."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
from conftest import rest_slow
from shipped import shipped

import simbias
from simbias.__main__ import main
from simbias.config import ConfigError, compose, memory, options, sweeps
from simbias.config.components import component_class, constructor_parameters
from simbias.core.errors import LONGEST_KEY
from simbias.core.messages import LONGEST

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
        for figure, spec in compose([f"+sweep={name}"]).config["sweep"].get("figures", {}).items():
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


@pytest.mark.parametrize(
    "override",
    rest_slow(
        5,
        [
            "hardware.inertia_error=1e308",
            "task.time_step=1e-9",
            f"task.horizon={10**30}",
            "task.start.mean=[1e300,0,0,0,0,0]",
            f"seed={'9' * 5000}",
            "hardware.inertia_error=-1",
            "hardware.iterations=1000000000",
            "hardware.noise.torque_variance=1e300",
            "task.time_step=2",
            "task.horizon=100000000",
            "task.robot.leg_mass=1e300",
            f"optimizer.max_evaluations={10**18}",
            f"optimizer.max_steps={10**18}",
            f"method.experiments={10**9}",
            "policy.bound=1000",
            f"seed={2**64}",
            f"bias.d={'9' * 5000}",
            "bias.d=1e300",
        ],
    ),
)
def test_a_number_out_of_its_range_is_one_short_line(override: str) -> None:
    with pytest.raises(ConfigError) as error:
        simbias.load([override, "tracking=none"])
    assert override.partition("=")[0] in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < LONGEST + LONGEST_KEY + 3


def test_a_deviation_of_next_to_nothing_is_refused() -> None:
    """CMA-ES could not begin with it."""
    with pytest.raises(ConfigError, match=r"^optimizer\.initial_deviation: must be greater than"):
        simbias.load(["optimizer=cma", "optimizer.initial_deviation=5e-324", "tracking=none"])


@pytest.mark.parametrize("override", ["task.time_step=1e-6", "task.horizon=9"])
def test_an_experiment_in_which_nothing_can_fail_is_refused(
    override: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every policy would succeed."""
    for more in ([], ["+sweep=smoke", "sweep.dry_run=true"]):
        assert main([override, *more, "tracking=none"]) == 2
        assert "s, in which nothing can fail; at least 0.01 s are needed" in capsys.readouterr().err


def test_a_simulated_rollout_in_which_nothing_can_fail_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^evaluation\.seconds: must be greater than or equal to 0\.01"):
        simbias.load(["evaluation=domain_randomization_30s", "evaluation.seconds=1e-10", "tracking=none"])


@pytest.mark.slow
def test_what_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = ["evaluation=robust", "hardware.noise.torque_variance=0.1", "evaluation.rollouts=10000"]
    with pytest.raises(ConfigError, match=r"^task\.horizon: 10000000 frames .* 10000 rollouts .* GiB"):
        simbias.load([*noise, "task.horizon=10000000", "tracking=none"])
    monkeypatch.setattr(memory, "machine_bytes", lambda: 300_000)
    with pytest.raises(ConfigError, match=r"^task\.horizon: 5400 frames of an experiment take at least"):
        simbias.load(["task.horizon=5400", "tracking=none"])
    simbias.load(["task.horizon=5300", "tracking=none"])
    monkeypatch.setattr(memory, "machine_bytes", lambda: None)
    simbias.load(["task.horizon=10000000", "tracking=none"])


def test_machines_tell_their_memory() -> None:
    there = memory.machine_bytes()
    assert there is None or 2**28 < there < 2**50


@pytest.mark.parametrize("trials", [5_000, 10**30])
def test_a_sweep_that_is_too_large_is_refused_at_once(
    trials: int, capsys: pytest.CaptureFixture[str]
) -> None:
    began = time.monotonic()
    assert main(["+sweep=table2", f"sweep.trials={trials}", "tracking=none"]) == 2
    assert time.monotonic() - began < 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("simbias: sweep.trials: ")
    assert "100000" in line


@pytest.mark.slow
def test_axes_that_are_too_large_are_refused_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    values = ",".join(map(str, range(1, 400)))
    axes = f"{{bias.d: [{values}], hardware.iterations: [{values}]}}"
    assert main([f"+sweep={{trials: 1, axes: {axes}}}", "tracking=none"]) == 2
    assert capsys.readouterr().err == (
        "simbias: sweep.trials: 159201 cells of 1 trials are more than 100000 trials\n"
    )
