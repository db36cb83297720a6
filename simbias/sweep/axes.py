"""The axes of a sweep's grid, as its YAML declares them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NotRequired, Required

from simbias.config import ConfigError
from simbias.config.components import validate

RESERVED = frozenset(  # columns of tracking.results and sweep.tables, beside those of the axes
    [
        *("hash", "repetition", "seed", "outcome", "experiments", "iterations", "seconds", "raised"),
        *("hardware_seconds", "test_episodes", "long_success_rate", "long_seconds"),
        *("trials", "succeeded", "mean", "low", "high", "success_rate", "reliable", "paper"),
    ]
)


@dataclass(frozen=True)
class Axis:
    """A dimension of the grid: points that each set the same keys."""

    name: str
    keys: tuple[str, ...]
    values: tuple[tuple[Any, ...], ...]  # of each point, in the order of the keys
    labels: tuple[str, ...]  # of each point
    texts: tuple[tuple[str, ...], ...]  # of each point, a text for each column of a table
    added: frozenset[str] = frozenset()  # keys that the config lacks, with a + in the YAML

    @property
    def numeric(self) -> bool:
        """Whether its labels are its values, and these are numbers."""
        numbers = (isinstance(value, int | float) for point in self.values for value in point)
        own = all(label == join(value) for label, value in zip(self.labels, self.values, strict=True))
        return own and all(numbers)

    def settings(self, index: int) -> dict[str, Any]:
        """What a point sets; keys that the config lacks begin with +, as in an override."""
        names = (f"+{key}" if key in self.added else key for key in self.keys)
        return dict(zip(names, self.values[index], strict=True))


def read_axis(name: str, spec: Any) -> Axis:
    """An axis from `key: [value, ...]` or `name: {keys, values, labels}`."""
    where = f"sweep.axes.{name}"
    if name in RESERVED - {"seed"}:
        raise ConfigError(where, "an axis may not have this name: tables have a column of this name")
    if not isinstance(spec, Mapping):
        spec = {"keys": name, "values": spec}
    fields = {
        "keys": Required[str | list[str]],
        "values": Required[list[Any]],
        "labels": NotRequired[list[str | float]],
    }
    if not isinstance(spec.get("values"), list):
        raise ConfigError(where, f"must be a list of values, got {spec.get('values')!r}")
    checked = validate(spec, fields, where)
    if not checked["keys"]:
        raise ConfigError(where, "has no keys")
    one = isinstance(checked["keys"], str)
    written = (checked["keys"],) if one else tuple(checked["keys"])
    keys = tuple(key.lstrip("+") for key in written)
    values = tuple((value,) if one else _tuple(value, len(keys), where) for value in checked["values"])
    labels = tuple(map(label, checked.get("labels", map(join, values))))
    if not values:
        raise ConfigError(where, "has no values")
    if len(labels) != len(values):
        raise ConfigError(where, f"has {len(labels)} labels for {len(values)} values")
    if not all(text.isprintable() for text in (name, *labels)):
        raise ConfigError(where, "has a name or label with letters that cannot be printed")
    if len(set(labels)) != len(labels):
        raise ConfigError(where, f"has the same value or label twice: {', '.join(labels)}")
    texts = [[text] for text in labels] if one or "labels" in checked else [map(label, v) for v in values]
    added = frozenset(key for key, text in zip(keys, written, strict=True) if key != text)
    return Axis(name, keys, values, labels, tuple(map(tuple, texts)), added)


def _tuple(value: Any, length: int, where: str) -> tuple[Any, ...]:
    """The values of a point, one for each key."""
    if not isinstance(value, list) or len(value) != length:
        raise ConfigError(where, f"each of its values must list {length}, one for each key, got {value!r}")
    return tuple(value)


def label(value: Any) -> str:
    """A value as tables show it."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def join(values: Sequence[Any]) -> str:
    """The values of a point as tables show them."""
    return "/".join(map(label, values))
