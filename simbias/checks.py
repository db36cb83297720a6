"""What enters from a hardware is checked once, here: shapes, numbers, length."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from simbias.interfaces import Hardware, HardwareError, Task
from simbias.records import Array, Rollout


def checked(rollout: Any, hardware: Hardware, task: Task) -> Rollout:
    """A hardware's rollout, its arrays as float64.

    Raises
    ------
    HardwareError
        In one line that names the component, the field, what was expected and what came.
    """
    source = type(hardware).__name__
    if not isinstance(rollout, Rollout):
        raise HardwareError(f"{source}.run: expected a Rollout, got {type(rollout).__name__}")
    n, m, T = len(task.states), len(task.inputs), task.horizon
    inputs = _array(rollout.inputs, f"{source}.run: inputs", (None, m))
    k = len(inputs)
    states = _array(rollout.states, f"{source}.run: states", (k + 1, n))
    measured = rollout.measured
    if measured is not None:
        measured = _array(measured, f"{source}.run: measured", (k + 1, n))
    if k > T:
        raise HardwareError(f"{source}.run: expected at most {T} frames, got {k}")
    if rollout.failed_at is None and k < T:
        raise HardwareError(
            f"{source}.run: ended after {k} of {T} frames without a failure; failed_at and failure say of one"
        )
    if rollout.failed_at is not None and rollout.failed_at != k:
        raise HardwareError(f"{source}.run: expected failed_at {k}, the last frame, got {rollout.failed_at}")
    failure = rollout.failure if rollout.failed_at is None else str(rollout.failure or "failed")
    return replace(rollout, states=states, inputs=inputs, measured=measured, failure=failure)


def _array(value: Any, name: str, shape: tuple[int | None, int]) -> Array:
    """An array of finite numbers of this shape; None is any length."""
    words = f"({', '.join('k' if length is None else str(length) for length in shape)})"
    try:
        array = np.asarray(value)
        if not np.issubdtype(array.dtype, np.floating) and not np.issubdtype(array.dtype, np.integer):
            raise HardwareError(f"{name}: expected real numbers, got {array.dtype}")
    except ValueError as error:
        raise HardwareError(f"{name}: expected the shape {words}, got rows of several lengths") from error
    if array.ndim != 2 or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise HardwareError(f"{name}: expected the shape {words}, got {array.shape}")
    wrong = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(wrong):
        raise HardwareError(f"{name}: expected finite numbers, got {array[wrong[0]]} in frame {wrong[0]}")
    return np.ascontiguousarray(array, dtype=np.float64)
