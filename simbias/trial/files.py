"""Rollouts as files, and any other results that hardware returns."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from simbias.core import Task
from simbias.core.errors import ConfigError
from simbias.core.messages import LONGEST_VALUE, printable
from simbias.core.records import Array, Rollout

LONGEST_PATH = 4096  # characters


def packed_rollout(rollout: Rollout, place: tuple[int, ...]) -> bytes:
    """A rollout and the place of its experiment in its trial, as an npz file; None fields are omitted.

    Compression would make it 5% smaller, but take 20 times as long.

    Fields: parameters (p,), states (k+1, n), inputs (k, m), measured (k+1, n), sensed, failed_at, failure,
    source, place. Costs are not kept, since they follow from these, and `given_start`, which follows from the
    method; `earlier` is always None.
    """
    left_out = ("cost", "given_start", "earlier", "continues")
    fields = ((name, value) for name, value in vars(rollout).items() if name not in left_out)
    given: dict[str, Any] = {name: value for name, value in fields if value is not None}
    file = io.BytesIO()
    np.savez(file, place=np.array(place, dtype=np.int64), **given)
    return file.getvalue()


def largest(task: Task, theta: Array, place: tuple[int, ...]) -> int:
    """The maximum size in bytes of `packed_rollout` for an experiment with theta (p,)."""
    T, failure, source = task.horizon, LONGEST_VALUE * "-", LONGEST_PATH * "-"
    states, inputs = np.zeros((T + 1, len(task.states))), np.zeros((T, len(task.inputs)))
    rollout = Rollout(states, inputs, T, failure, measured=states, parameters=theta, source=source)
    return len(packed_rollout(rollout, place))


def load_rollout(path: Path) -> tuple[Rollout, tuple[int, ...]]:
    """The rollout and its place, from a file written by `packed_rollout`; ConfigError for another kind."""
    with path.open("rb") as file:
        if file.read(2) != b"PK":  # as every zip file begins; NumPy would advise to unpickle it
            raise ConfigError(str(path), "is no npz file")
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    place = tuple(arrays.pop("place").tolist())
    fields: dict[str, Any] = {name: each if each.ndim else each.item() for name, each in arrays.items()}
    return Rollout(**fields), place


def raw_json(content: Any) -> str:
    """Anything as JSON: arrays as lists, every number in full, objects as their fields, the rest as text."""
    try:
        return json.dumps(content, indent=1, default=_plain)
    except (TypeError, ValueError, RecursionError):  # keys that are no strings, or a cycle
        return json.dumps(_text(content))


def _plain(thing: Any) -> Any:
    """Convert an object to JSON's types, or into parts that are converted in turn."""
    if isinstance(thing, np.ndarray | np.generic) and thing.dtype.kind in "biufO":
        return thing.tolist()
    return dict(vars(thing)) if getattr(thing, "__dict__", None) else _text(thing)


def _text(thing: Any) -> str:
    """An object as text, with every number in full."""
    try:
        with np.printoptions(threshold=sys.maxsize, precision=17):
            return printable(repr(thing))
    except Exception:
        return f"a {type(thing).__name__} that cannot be shown"
