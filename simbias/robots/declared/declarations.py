"""Parts of a declared task as in its YAML, and the records made from them."""

from __future__ import annotations

import ast
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from pydantic import AfterValidator, Field

from simbias.core import Criterion, Push
from simbias.core.ranges import Coordinate, Force, NonNegative, Seconds
from simbias.core.records import Array
from simbias.robots.declared.starts import Range
from simbias.simulation.compiler import Expression


@dataclass(frozen=True)
class Input:
    """An input u: |u| <= limit, or lower <= u <= limit, as for a propeller that only pushes."""

    unit: str
    limit: Force
    kind: str = ""
    lower: Coordinate | None = None


@dataclass(frozen=True)
class Output:
    """A quantity that a policy may feed back."""

    value: Expression
    unit: str = ""


@dataclass(frozen=True)
class Failure:
    """A failure criterion: the value is above its upper bound or, if it has a lower bound, below that."""

    value: Expression
    unit: str = ""
    above: Coordinate | None = None
    below: Coordinate | None = None
    words: str = ""  # "the pole falls"; by default its name


@dataclass(frozen=True)
class Pulses:
    """Pushes on an input during an episode (`simbias.core.Push`)."""

    count: Annotated[int, Field(gt=0, le=1000)]
    amplitude: Range  # least and largest, in the input's unit; of either sign
    seconds: Annotated[list[Seconds], Field(min_length=2, max_length=2)]  # a pulse's standard deviation


@dataclass(frozen=True)
class DrawnPart:
    """A part of a drawing: one point is a disc's centre, two are a bar's ends, more are corners."""

    points: Annotated[
        list[Annotated[list[Expression], Field(min_length=2, max_length=2)]], Field(min_length=1)
    ]
    thickness: NonNegative = 0.02  # of a disc or a bar, in the points' unit
    grey: Annotated[float, Field(ge=0, le=1)] | None = None  # 0 black, 1 white; null: as in the key


_Value = TypeVar("_Value")


def _in_order(values: dict[str, _Value]) -> tuple[tuple[str, _Value], ...]:
    """Items of a mapping as a tuple, so that their order counts in a trial's identity."""
    return tuple(values.items())


def _names(values: dict[str, _Value]) -> dict[str, _Value]:
    """Check that expressions can use the names."""
    for name in values:
        if not name.isidentifier():
            raise ValueError(f"{name!r} is not a name: use letters, digits and _, as in d_angle")
    return values


Named = Annotated[dict[str, _Value], AfterValidator(_names), AfterValidator(_in_order)]


def measure_of(name: str, failure: Failure) -> str:
    """The expression whose value exceeds the criterion's limit if x fails."""
    if (failure.above is None) == (failure.below is None):
        raise ValueError(f"{name}: needs one of above and below")
    return failure.value if failure.below is None else f"-({failure.value}\n)"  # it may end with a comment


def push_of(name: str, pulses: Pulses, inputs: Sequence[str], time_step: float) -> Push:
    """Pushes on one of these inputs, with frames of `time_step` seconds."""
    if name not in inputs:
        raise ValueError(f"pushes: no input is called {name}; available: {', '.join(inputs)}")
    amplitude, seconds = (pulses.amplitude[0], pulses.amplitude[1]), (pulses.seconds[0], pulses.seconds[1])
    for key, (least, most) in (("amplitude", amplitude), ("seconds", seconds)):
        if not 0 <= least <= most:
            raise ValueError(f"pushes.{name}.{key}: expected 0 <= least <= most, got [{least:g}, {most:g}]")
    if seconds[0] < time_step / 2:
        raise ValueError(
            f"pushes.{name}.seconds: expected at least half a frame ({time_step / 2:g} s), got {seconds[0]:g}"
        )
    return Push(inputs.index(name), pulses.count, amplitude, seconds)


def bounds_of(inputs: Mapping[str, Input]) -> tuple[Array, Array]:
    """Lower and upper limits (m,) of the inputs."""
    upper = np.array([each.limit for each in inputs.values()])
    lower = np.array([-each.limit if each.lower is None else each.lower for each in inputs.values()])
    for name, least, most in zip(inputs, lower.tolist(), upper.tolist(), strict=True):
        if not least < most:
            raise ValueError(f"inputs.{name}: lower is {least:g}; it must be below the limit {most:g}")
    return lower, upper


def within_abs(expression: str) -> tuple[str, bool]:
    """An expression in one spelling, without an outer `abs`, and whether it has one."""
    node = ast.parse(expression.strip(), mode="eval").body
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "abs":
        return ast.unparse(node.args[0]), True
    return ast.unparse(node), False


def check_units(group: str, conditions: Mapping[str, Failure], units: Mapping[str, str]) -> None:
    """Refuse a condition on a quantity, or on its magnitude, in another unit: nothing is converted."""
    for key, each in conditions.items():
        value, _ = within_abs(each.value)
        unit = units.get(value, "")
        if each.unit and unit and each.unit != unit:
            said = f"{value} is in {unit}, and bounds are not converted: give this one in {unit}"
            raise ValueError(f"{group}.{key}.unit is {each.unit}, but {said}")


def criterion_of(name: str, failure: Failure, states: Collection[str]) -> Criterion:
    """The failure criterion; an upper limit on |state| is also a bound on that state."""
    limit = failure.above if failure.above is not None else -(failure.below or 0.0)
    value = failure.value.replace(" ", "")
    bounds = {state: limit for state in states if failure.below is None and value == f"abs({state})"}
    return Criterion(name, failure.words or name.replace("_", " "), limit, failure.unit, bounds)


def bound_of(condition: Failure) -> float:
    """The number that a condition's value is compared with."""
    return criterion_of("", condition, ()).limit * (1.0 if condition.below is None else -1.0)
