"""What a file of configs may be: one that can be read at once, and that stays small when it is."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import yaml

from simbias.core.errors import ConfigError

MOST_VALUES = 100_000  # of a file, each counted as often as aliases repeat it


def check_file(path: Path) -> None:
    """Refuse what others would wait for: a pipe or a device, or aliases of aliases that repeat without end.

    Whatever else is wrong is told when it is read.

    Raises
    ------
    ConfigError
        Naming the file.
    """
    if os.path.isdir(path) or not os.path.exists(path):
        return
    if not os.path.isfile(path):
        raise ConfigError(str(path), "is neither a file nor a folder")
    size = 0
    with suppress(OSError, UnicodeError, RecursionError, yaml.YAMLError):
        text = path.read_text(encoding="utf-8")
        if "&" in text and "*" in text:
            size = _size(yaml.compose(text, yaml.SafeLoader), {})
    if size > MOST_VALUES:
        raise ConfigError(str(path), f"has more than {MOST_VALUES} values, as its aliases repeat others")


def _size(node: yaml.Node | None, known: dict[int, int]) -> int:
    """How many values a node has when its aliases are written out; a circle counts once."""
    key = id(node)
    if key not in known:
        known[key] = 1
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        flat = [each for part in parts for each in (part if isinstance(part, tuple) else (part,))]
        known[key] = 1 + sum(_size(each, known) for each in flat)
    return known[key]
