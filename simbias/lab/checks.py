"""Checks of rollouts from hardware: shapes, numbers, length, safety limits."""

from __future__ import annotations

import operator
from dataclasses import replace
from typing import Any

import numpy as np

from simbias.core import HardwareError, Task, wrapped
from simbias.core.messages import LONGEST_VALUE, brief, quote
from simbias.core.quantities import unwound
from simbias.core.records import Array, Rollout
from simbias.lab.safety import Bounds, hold

START_DEVIATIONS = 20.0  # deviations of the task's starts: tolerance of an experiment's start
LARGEST = 1e15  # of a state or input in any unit: no sensor exceeds it, and its square fits float32


def start_tolerance(task: Task) -> Array:
    """Largest allowed deviation (n,) from the requested start; inf where starts do not vary."""
    return np.where(task.start_deviation > 0, START_DEVIATIONS * task.start_deviation, np.inf)


def check_rollout(
    rollout: Any, source: str, task: Task, bounds: Bounds | None = None, start: Array | None = None
) -> Rollout:
    """Check a rollout and copy it to float64 arrays, within safety limits, without cost and parameters.

    Unless its states are measured, it has to begin near the start (n,), if given, and is cut at the first
    state that violates a criterion, if it names no failure.

    Raises
    ------
    HardwareError
        One line: source, field, expected value, given value.
    """
    if not isinstance(rollout, Rollout):
        raise HardwareError(f"{source}: expected a Rollout, got {type(rollout).__name__}")
    n, m, T = len(task.states), len(task.inputs), task.horizon
    try:
        inputs = _array(rollout.inputs, f"{source}: inputs", (None, m))
    except HardwareError as error:
        if words := _not_finite(rollout, task):
            raise HardwareError(words) from error
        raise
    k = len(inputs)
    states = unwound(_array(rollout.states, f"{source}: states", (k + 1, n)), task.states)
    measured = rollout.measured
    if measured is not None:
        measured = unwound(_array(measured, f"{source}: measured", (k + 1, n)), task.states)
    if not isinstance(rollout.sensed, bool | np.bool_):
        raise HardwareError(f"{source}: sensed: expected true or false, got {quote(rollout.sensed)}")
    if k > T:
        raise HardwareError(
            f"{source}: inputs: expected at most {T} frames of {task.time_step:g} s, got {k}; "
            "does it run at another rate?"
        )
    if start is not None and not rollout.sensed:
        off = np.abs(wrapped(states[0] - start, task.states)) / start_tolerance(task)
        if off.max() > 1:
            state, at = task.states[i := int(off.argmax())], start[i]
            raise HardwareError(
                f"{source}: states: expected {state.name} to begin at {at:g} {state.unit}, within "
                f"{START_DEVIATIONS:g} deviations of the task's starts, got {states[0, i]:g}; is the unit "
                f"wrong? If sensors measured these states, give the rollout sensed=True; if the hardware "
                f"cannot begin at the start that it is given, set sets_start to False"
            )
    failed_at, failure = _frame(rollout.failed_at, f"{source}: failed_at"), rollout.failure
    checked = Rollout(states, inputs, measured=measured, sensed=bool(rollout.sensed))
    ends = np.flatnonzero(task.violated(states[1:]) >= 0)
    if failed_at is None and not rollout.sensed and len(ends):
        failed_at = k = int(ends[0]) + 1  # a custom class may not have checked failures
        checked, failure = checked.part(0, k), task.failure(states[k])
    if failed_at is None and k < T:
        raise HardwareError(
            f"{source}: ended after {k} of {T} frames without a failure; report one in failed_at and failure"
        )
    if failed_at not in (None, k):
        raise HardwareError(f"{source}: failed_at: expected {k}, the last frame, got {failed_at}")
    failure = _failure(failure, failed_at, f"{source}: failure")
    file = rollout.source and str(rollout.source)
    checked = replace(checked, failed_at=failed_at, failure=failure, source=file)
    return checked if bounds is None else hold(checked, task, bounds, source)


def _not_finite(rollout: Rollout, task: Task) -> str:
    """The output of the task that first made an input not finite, in words; empty if none did."""
    try:
        seen = np.asarray(rollout.states if rollout.measured is None else rollout.measured, np.float64)
        frame = int(np.argmin(np.isfinite(np.asarray(rollout.inputs, np.float64)).all(axis=1)))
        wrong = np.flatnonzero(~np.isfinite(task.output(seen[frame])))
    except (TypeError, ValueError, IndexError):  # other shapes
        return ""
    if not len(wrong) or not np.isfinite(seen[frame]).all():
        return ""
    at = ", ".join(
        f"{each.name} {x:.3g} {each.unit}" for each, x in zip(task.states, seen[frame], strict=True)
    )
    return f"task.outputs.{task.outputs[wrong[0]].name} is not finite in frame {frame}, at {at}"


def _array(given: Any, name: str, shape: tuple[int | None, int]) -> Array:
    """A float64 copy of finite numbers in this shape; None: any length."""
    words = f"({', '.join('k' if length is None else str(length) for length in shape)})"
    try:
        rows = given if isinstance(given, list | tuple) else [given]
        masked = any(isinstance(row, np.ma.MaskedArray) for row in rows)
        array = np.ma.array(given, dtype=np.float64).filled(np.nan) if masked else np.asarray(given)
    except Exception as error:  # rows of different lengths, or a custom class
        raise HardwareError(f"{name}: expected the shape {words}, got {quote(given)}") from error
    if not np.issubdtype(array.dtype, np.floating) and not np.issubdtype(array.dtype, np.integer):
        kind = quote(given) if array.ndim == 0 else array.dtype
        raise HardwareError(f"{name}: expected real numbers, got {kind}")
    if array.shape == (0,):  # from an empty list, which has no columns
        array = array.reshape(0, shape[1])
    if array.ndim != 2 or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise HardwareError(f"{name}: expected the shape {words}, got {array.shape}")
    with np.errstate(over="ignore"):  # values beyond float64 are refused as not finite
        own = np.array(array, dtype=np.float64, order="C")
    wrong = np.flatnonzero(~(np.abs(own) <= LARGEST).all(axis=1))
    if len(wrong):
        expected = f"numbers up to {LARGEST:g}" if np.isfinite(own).all() else "finite numbers"
        raise HardwareError(
            f"{name}: expected {expected}, got {quote(own[wrong[0]].tolist())} in frame {wrong[0]}"
        )
    return own


def _frame(given: Any, name: str) -> int | None:
    """An integer frame, or None."""
    if given is None:
        return None
    if isinstance(given, float | np.floating) and float(given).is_integer():
        return int(given)
    try:
        return operator.index(given)
    except Exception as error:
        raise HardwareError(f"{name}: expected a frame or None, got {quote(given)}") from error


def _failure(given: Any, failed_at: int | None, name: str) -> str | None:
    """The name of a failure, checked to be short enough to store; None without a failure."""
    if given is not None and not isinstance(given, str):
        raise HardwareError(f"{name}: expected a name or None, got {quote(given)}")
    if failed_at is None and given is not None:
        raise HardwareError(f"{name}: expected None without failed_at, got {quote(given)}")
    return None if failed_at is None else brief(given or "", LONGEST_VALUE) or "failed"
