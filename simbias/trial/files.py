"""Rollouts as files, and any other results of a hardware."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from simbias.core.messages import printable, quote
from simbias.core.records import Rollout

TEXTS = "UST"  # kinds of NumPy's types that are no numbers
RESERVED = ("file", "allow_pickle")  # arguments of `numpy.savez`
SCALARS = ("sensed", "cost", "failed_at", "failure")  # of a rollout


def save_rollout(file: IO[bytes], rollout: Rollout, place: tuple[int, ...] = ()) -> None:
    """Write a rollout, and the place of its experiment in its trial, as npz; what is None is left out.

    Compressed, it would be 5% smaller, and take 20 times as long.

    Fields: parameters (p,), states (k+1, n), inputs (k, m), measured (k+1, n), sensed, cost, failed_at,
    failure, place.
    """
    given: dict[str, Any] = {name: value for name, value in vars(rollout).items() if value is not None}
    np.savez(file, place=np.array(place, dtype=np.int64), **given)


def load_rollout(path: Path) -> tuple[Rollout, tuple[int, ...]]:
    """The rollout and its place, as `save_rollout` wrote them."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    place = tuple(arrays.pop("place").tolist())
    scalars = {name: arrays.pop(name).item() for name in SCALARS if name in arrays}
    return Rollout(**arrays, **scalars), place


def raw_parts(returned: Any) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """The parts by name of any result of a hardware: those that are numbers, and the others as text.

    Parts are the fields of an object, the items of a mapping or of a list that is no array; else there is
    one, `returned`.
    """
    arrays: dict[str, NDArray[Any]] = {}
    texts: dict[str, str] = {}
    for name, part in _parts(returned).items():
        try:
            array = np.asarray(part)
            if array.dtype.hasobject or array.dtype.kind in TEXTS:
                raise TypeError("no numbers")
        except Exception:
            texts[name] = _text(part)
        else:
            arrays[name] = array
    return arrays, texts


def _parts(returned: Any) -> dict[str, Any]:
    """The parts of an object, by names that a file may have."""
    named: Iterable[tuple[Any, Any]] = [("returned", returned)]
    if not _is_array(returned):
        if isinstance(returned, Mapping):
            named = returned.items()
        elif isinstance(returned, list | tuple):
            named = enumerate(returned)
        elif getattr(returned, "__dict__", None):
            named = vars(returned).items()
    parts: dict[str, Any] = {}
    for name, part in named:
        key = re.sub(r"\W", "_", name if isinstance(name, str) else quote(name))
        while key in parts or key in RESERVED:
            key += "_"
        parts[key] = part
    return parts


def _is_array(thing: Any) -> bool:
    """Whether NumPy makes one array of numbers of it."""
    try:
        return not np.asarray(thing).dtype.hasobject
    except Exception:
        return False


def _text(thing: Any) -> str:
    """A thing in words, every number of it in full."""
    try:
        with np.printoptions(threshold=sys.maxsize, precision=17):
            return printable(repr(thing))
    except Exception:
        return f"a {type(thing).__name__} that cannot be shown"
