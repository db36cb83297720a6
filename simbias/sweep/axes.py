"""The axes of a sweep's grid, as its YAML declares them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, NotRequired, Required

from simbias.config import ConfigError
from simbias.config.components import validate

ONLY = NotRequired[list[Any] | None]


class Point(NamedTuple):
    """A point of an axis: some keys with their values."""

    label: str
    values: Mapping[str, Any]  # by key; a new key is prefixed with +
    texts: Sequence[str]  # one for each of its columns in a table


@dataclass(frozen=True)
class Axis:
    """A dimension of the grid."""

    name: str
    points: tuple[Point, ...]
    left_out: tuple[str, ...] = ()  # labels of declared points that are not run

    @property
    def labels(self) -> tuple[str, ...]:
        """The label of each point."""
        return tuple(point.label for point in self.points)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that the points set."""
        return tuple(dict.fromkeys(key.lstrip("+") for point in self.points for key in point.values))

    @property
    def heads(self) -> list[str]:
        """Headings of its columns in a table: its name, or its keys, without their groups, in words."""
        keys = self.keys if len(self.points[0].texts) > 1 else [self.name]
        return [_in_words(key) for key in keys]

    def words(self, label: str) -> str:
        """A point by its label; a number comes with the axis' name."""
        return f"{_in_words(self.name)} {label}" if self.numeric else label

    @property
    def numeric(self) -> bool:
        """Whether the labels are the points' values, which are numbers."""
        values = [(point.label, list(point.values.values())) for point in self.points]
        numbers = (isinstance(value, int | float) for _, point in values for value in point)
        return all(label == join(point) for label, point in values) and all(numbers)


def _in_words(key: str) -> str:
    """A key without its groups, in words."""
    return key.split(".")[-1].replace("_", " ")


def in_words(axes: Sequence[Axis], labels: Sequence[str]) -> str:
    """A point of each axis, by its label; numbers come with the names of their axes."""
    return ", ".join(axis.words(label) for axis, label in zip(axes, labels, strict=True))


def read_axis(name: str, spec: Any) -> Axis:
    """An axis: `key: [value, ...]`, `name: {keys, values, labels}` or `name: {points}`.

    `points` maps labels to values by key; points may set different keys. `only` lists the labels of points to
    keep.
    """
    from simbias.sweep.results import COLUMNS  # lazily: avoids an import cycle
    from simbias.sweep.tables import MEASURES

    where = f"sweep.axes.{name}"
    if name != "seed" and name in (*COLUMNS, *MEASURES):
        raise ConfigError(where, f"is a column's name; choose another: {{other: {{keys: {name}, ...}}}}")
    if not isinstance(spec, Mapping):
        spec = {"keys": name, "values": spec}
    if "points" in spec:
        checked = validate(spec, {"points": Required[dict[str, dict[str, Any]]], "only": ONLY}, where)
        points = [Point(text, values, [text]) for text, values in checked["points"].items()]
        return _axis(name, points, checked.get("only"))
    fields = {
        "keys": Required[str | list[str]],
        "values": Required[list[Any]],
        "labels": NotRequired[list[str | float]],
        "only": ONLY,
    }
    if spec and not spec.keys() & (fields.keys() - {"only"}):
        key, value = name, spec
        while isinstance(value, Mapping) and value:
            inner, value = next(iter(value.items()))
            key += f".{inner}"
        if key.endswith(".only"):
            raise ConfigError(
                f"sweep.axes.{key.removesuffix('.only')}",
                "no such axis; `only` keeps points of one that the sweep has",
            )
        dotted = f"; for a key with dots: '+sweep.axes={{{key}: [...]}}'"
        otherwise = dotted if isinstance(value, list) else ", or have keys and values, or points"
        raise ConfigError(where, f"must be a list of values{otherwise}")
    if not isinstance(spec.get("values"), list):
        raise ConfigError(where, f"must be a list of values, got {spec.get('values')!r}")
    checked = validate(spec, fields, where)
    if not checked["keys"]:
        raise ConfigError(where, "has no keys")
    one = isinstance(checked["keys"], str)
    written = [re.sub(r"^\++", "+", key) for key in ([checked["keys"]] if one else checked["keys"])]
    if len({key.lstrip("+") for key in written}) != len(written):
        raise ConfigError(where, f"names a key twice: {', '.join(written)}")
    values = [(value,) if one else _tuple(value, len(written), where) for value in checked["values"]]
    labels = [*map(label, checked.get("labels", map(join, values)))]
    if len(labels) != len(values):
        raise ConfigError(where, f"has {len(labels)} labels for {len(values)} values")
    apart = not one and "labels" not in checked  # a column for each key
    points = [
        Point(text, dict(zip(written, value, strict=True)), [*map(label, value)] if apart else [text])
        for text, value in zip(labels, values, strict=True)
    ]
    return _axis(name, points, checked.get("only"))


def _axis(name: str, points: Sequence[Point], only: Sequence[Any] | None) -> Axis:
    """The axis with these points, which have to be distinct, or with those that have one of some labels."""
    where, labels = f"sweep.axes.{name}", [point.label for point in points]
    if not points:
        raise ConfigError(where, "has no values")
    if not all(text.isprintable() for text in (name, *labels)):
        raise ConfigError(where, "has a name or label with unprintable characters")
    if len(set(labels)) != len(labels):
        raise ConfigError(where, f"has the same value or label twice: {', '.join(labels)}")
    if only is None:
        return Axis(name, tuple(points))
    wanted = [str(each) if str(each) in labels else label(each) for each in only]
    if not wanted:
        raise ConfigError(f"{where}.only", f"keeps no point; there are {', '.join(labels)}")
    for each in wanted:
        if each not in labels:
            raise ConfigError(f"{where}.only", f"no such point: {each}; there are {', '.join(labels)}")
    kept = tuple(point for point in points if point.label in wanted)
    return Axis(name, kept, tuple(text for text in labels if text not in wanted))


def _tuple(value: Any, length: int, where: str) -> tuple[Any, ...]:
    """The values of a point, one for each key."""
    if not isinstance(value, list) or len(value) != length:
        raise ConfigError(where, f"each of its values must list {length}, one for each key, got {value!r}")
    return tuple(value)


def label(value: Any) -> str:
    """A value as shown in tables."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def join(values: Sequence[Any]) -> str:
    """The values of a point as shown in tables."""
    return "/".join(map(label, values))
