"""The axes of a sweep's grid, as its YAML declares them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NotRequired, Required

from simbias.config import ConfigError
from simbias.config.components import validate

ONLY = NotRequired[list[Any] | None]


@dataclass(frozen=True)
class Axis:
    """A dimension of the grid: points that each set some keys."""

    name: str
    points: tuple[Mapping[str, Any], ...]  # values by key; a new key is prefixed with +
    labels: tuple[str, ...]  # label of each point
    texts: tuple[tuple[str, ...], ...]  # for each point, a text per column of a table
    left_out: tuple[str, ...] = ()  # labels of declared points that are not run

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys that the points set."""
        return tuple(dict.fromkeys(key.lstrip("+") for point in self.points for key in point))

    @property
    def heads(self) -> list[str]:
        """Headings of its columns in a table: its name, or its keys, without their groups, in words."""
        keys = self.keys if len(self.texts[0]) > 1 else [self.name]
        return [_in_words(key) for key in keys]

    def words(self, label: str) -> str:
        """A point by its label; a number comes with the axis' name."""
        return f"{_in_words(self.name)} {label}" if self.numeric else label

    @property
    def numeric(self) -> bool:
        """Whether the labels are the points' values, which are numbers."""
        values = [list(point.values()) for point in self.points]
        numbers = (isinstance(value, int | float) for point in values for value in point)
        own = all(label == join(value) for label, value in zip(self.labels, values, strict=True))
        return own and all(numbers)


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
        points = checked["points"]
        axis = Axis(name, tuple(points.values()), tuple(points), tuple((text,) for text in points))
        return _kept(_checked(axis), checked.get("only"))
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
    labels = tuple(map(label, checked.get("labels", map(join, values))))
    if len(labels) != len(values):
        raise ConfigError(where, f"has {len(labels)} labels for {len(values)} values")
    texts = [[text] for text in labels] if one or "labels" in checked else [map(label, v) for v in values]
    points = tuple(dict(zip(written, value, strict=True)) for value in values)
    return _kept(_checked(Axis(name, points, labels, tuple(map(tuple, texts)))), checked.get("only"))


def _kept(axis: Axis, only: Sequence[Any] | None) -> Axis:
    """The axis with the points of these labels, in its own order."""
    if only is None:
        return axis
    where = f"sweep.axes.{axis.name}.only"
    wanted = [str(each) if str(each) in axis.labels else label(each) for each in only]
    if not wanted:
        raise ConfigError(where, f"keeps no point; there are {', '.join(axis.labels)}")
    for each in wanted:
        if each not in axis.labels:
            raise ConfigError(where, f"no such point: {each}; there are {', '.join(axis.labels)}")
    at = [index for index, text in enumerate(axis.labels) if text in wanted]
    points, texts = tuple(axis.points[i] for i in at), tuple(axis.texts[i] for i in at)
    labels = tuple(axis.labels[i] for i in at)
    left_out = tuple(text for text in axis.labels if text not in wanted)
    return _checked(Axis(axis.name, points, labels, texts, left_out))


def _checked(axis: Axis) -> Axis:
    """The axis, if its points are distinct and can be drawn."""
    where = f"sweep.axes.{axis.name}"
    if not axis.points:
        raise ConfigError(where, "has no values")
    if not all(text.isprintable() for text in (axis.name, *axis.labels)):
        raise ConfigError(where, "has a name or label with unprintable characters")
    if len(set(axis.labels)) != len(axis.labels):
        raise ConfigError(where, f"has the same value or label twice: {', '.join(axis.labels)}")
    return axis


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
