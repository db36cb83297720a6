"""Measurements from a lab at the task's frames, or refused in one line."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simbias.core import HardwareError, Task, wrapped
from simbias.core.quantities import unwound
from simbias.core.records import Array, Rollout
from simbias.lab.checks import START_DEVIATIONS, start_tolerance
from simbias.lab.rates import check_rates, rates_of
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.safety import RECORDED_ROUNDING, without_limits

FAILURE = "failure"  # column of a file, beside time, states and inputs
STILL = "simbias: %s: %s stands still while %s does not: is a sensor dead?"
OTHER = (
    "simbias: %s: %s differs from what the requested policy commands in these states: is it of another "
    "experiment, or late? If so, withdraw the experiment, or begin ask and tell again"
)
UNLIKE = 0.7  # of the root mean square of commands: larger differences suggest another policy
LASTS = 0.5  # autocorrelation above which a difference is not noise
JITTER = 0.25  # of a frame: tolerance for a row to be on time
GAP = 2.5  # intervals between rows; longer ones are gaps
COARSEST = 1.05  # of the task's time step: largest distance of rows
DEGREES, ABOUT = 180 / math.pi, 0.1  # degrees per radian; tolerance of a ratio that suggests it
NOISE = 1e-3  # rad or rad/s, below which a ratio is not meaningful
NEAR = 0.3  # rad, modulo a turn: angles that differ by less may be in radians


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured states and commanded inputs, a row for each time."""

    times: Array  # (r,) s
    states: Array  # (r, n) measured
    inputs: Array  # (r, m) commanded from this time on
    failure: str | None = None  # reported by the lab in the last row
    rows: tuple[int, ...] = ()  # (r,) row numbers in the file; the header is row 1


def frame(measured: Measurements, request: ExperimentRequest, source: str) -> Rollout:
    """Measurements at the task's frames, up to its first failure.

    More frequent rows are resampled: states are interpolated linearly, and an input is the mean of the inputs
    during the frame. Rarer rows, and gaps, are refused. Angles that wrap are unwound, from within half a turn
    of the requested start.

    Raises
    ------
    HardwareError
        The message begins with the source and names row and column in one line.
    """
    task = request.task
    rows = measured.rows or tuple(range(1, len(measured.times) + 1))
    times = measured.times - measured.times[0]
    _check_start(measured.states, rows, request, source)
    _check_times(times, rows, task, source)
    _check_inputs(measured.inputs[:-1], rows, request, source)  # no input acts after the last
    unwound = _unwound(measured.states, request)
    frames = np.arange(math.floor(times[-1] / task.time_step + JITTER) + 1)[: task.horizon + 1]
    wanted = frames * task.time_step
    if len(times) >= len(frames) and np.all(np.abs(times[: len(frames)] - wanted) <= JITTER * task.time_step):
        states, inputs = unwound[: len(frames)], measured.inputs[: len(frames) - 1]
    else:
        states = np.stack([np.interp(wanted, times, column) for column in unwound.T], axis=1)
        inputs = _means(times, measured.inputs, wanted)
    check_rates(source, [Rollout(states, inputs)], task, rates_of(task))
    _tell_what_stands_still(states, task, source)
    tell_other_commands(states, inputs, request, source)
    within = times[-1] <= (task.horizon + JITTER) * task.time_step  # a later failure is beyond the horizon
    failure = measured.failure if within else None
    ended = _ended(states, inputs, failure, unwound[-1], request, f"{source}: row {rows[-1]}")
    _check_changes(ended.inputs, times, rows, request, source)
    return ended


def _tell_what_stands_still(states: Array, task: Task, source: str) -> None:
    """Warn of a position that does not move while its rate is not zero, or the reverse."""
    for rate, position in rates_of(task).items():
        moves, has_rate = bool(np.ptp(states[:, position])), bool(states[:, rate].any())
        if moves != has_rate and len(states) > 1:  # a single row does not move
            still, other = (position, rate) if has_rate else (rate, position)
            names = (task.states[i].name for i in (still, other))
            logging.getLogger(__name__).warning(STILL, source, *names)


def tell_other_commands(states: Array, inputs: Array, request: ExperimentRequest, source: str) -> None:
    """Warn of inputs (k, m) unlike the policy's at the states (k+1, n), or a frame off.

    Differences due to noise in the policy's own sensors do not persist from frame to frame.
    """
    try:
        controller = without_limits(request.policy).controller(request.theta, request.task.time_step)
        asked = np.array([controller(x) for x in states[:-1]]).reshape(inputs.shape)
    except Exception:  # of the policy, which is also simulated: reported there
        return
    for quantity, u, commanded in zip(request.task.inputs, inputs.T, asked.T, strict=True):
        off = u - commanded
        lasts = off[1:] @ off[:-1] > LASTS * (off @ off)
        late = ((u, commanded), (u[1:], commanded[:-1]), (u[:-1], commanded[1:]))
        if lasts and all(np.sum((a - b) ** 2) > UNLIKE**2 * np.sum(b**2) for a, b in late):
            logging.getLogger(__name__).warning(OTHER, source, quantity.name)


def _unwound(states: Array, request: ExperimentRequest) -> Array:
    """States (r, n) with wrapping angles unwound, beginning within half a turn of the start."""
    states = unwound(states, request.task.states)
    away = states[0] - request.start
    return states + (wrapped(away, request.task.states) - away)


def _check_start(states: Array, rows: Sequence[int], request: ExperimentRequest, source: str) -> None:
    """Refuse a start other than the requested one, and degrees instead of radians."""
    task, start, got, begun = request.task, request.start, states[0], _unwound(states[:1], request)[0]
    reason = "; are these degrees?" if _in_degrees(got, start, task) else "; is the unit wrong?"
    for index, quantity in enumerate(task.states):
        limit, tolerance = request.bounds.states[index], start_tolerance(task)[index]
        where = f"{source}: row {rows[0]}, column {quantity.name}: expected"
        if abs(start[index]) <= limit < abs(begun[index]):
            raise HardwareError(f"{where} at most {limit:g} {quantity.unit}, got {got[index]:g}{reason}")
        if abs(begun[index] - start[index]) > tolerance:
            raise HardwareError(
                f"{where} the start {start[index]:g} within {tolerance:g} {quantity.unit} "
                f"({START_DEVIATIONS:g} deviations of the task's starts), got {got[index]:g}{reason}"
            )
    failure = task.failure(begun)
    if failure and not task.failure(start):
        raise HardwareError(
            f"{source}: row {rows[0]}: expected a start within the limits, got one that has failed "
            f"({task.words(failure)}){reason}"
        )
    for index, before in ((0, start), (1, got)):  # a template's first row is in radians
        if index < len(states) and _in_degrees(states[index], before, task):
            raise HardwareError(
                f"{source}: row {rows[index]}: expected radians, got values that are {DEGREES:.1f} times "
                f"{'the start' if index == 0 else 'those of the previous row'}; are these degrees?"
            )


def _in_degrees(x: Array, radians: Array, task: Task) -> bool:
    """Whether x (n,) is like the values in radians (n,), converted to degrees.

    If angles are far apart, the farthest decides alone: near zero, angles and rates are inaccurate or noise.
    """
    units = np.array([quantity.unit for quantity in task.states])
    angular = np.isin(units, ("rad", "rad/s")) & (np.abs(radians) > NOISE)
    far = angular & (units == "rad") & (np.abs(wrapped(x - radians, task.states)) > NEAR)
    if far.any():
        angular = np.arange(len(x)) == np.argmax(np.where(far, np.abs(x - radians), 0.0))
    ratio = x[angular] / radians[angular]
    return bool(len(ratio)) and bool((np.abs(ratio / DEGREES - 1) < ABOUT).all())


def _check_times(times: Array, rows: Sequence[int], task: Task, source: str) -> None:
    """Refuse times that do not increase, and rows that are too far apart or leave a gap."""
    steps = np.diff(times)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        row = rows[back[0] + 1]
        raise HardwareError(
            f"{source}: row {row}, column time: expected more than {times[back[0]]:g} s, the time of the "
            f"previous row, got {times[back[0] + 1]:g} s (since the first row)"
        )
    if not len(steps):
        return
    usual = float(np.median(steps))
    if usual > COARSEST * task.time_step:
        raise HardwareError(
            f"{source}: column time: expected a row at least every {task.time_step:g} s "
            f"({1 / task.time_step:g} Hz), got one every {usual:g} s ({1 / usual:.4g} Hz)"
        )
    gaps = np.flatnonzero(steps > GAP * max(usual, task.time_step))
    if len(gaps):
        raise HardwareError(
            f"{source}: row {rows[gaps[0] + 1]}, column time: expected no gap, got one of "
            f"{steps[gaps[0]]:g} s after {times[gaps[0]]:g} s"
        )


def _check_inputs(inputs: Array, rows: Sequence[int], request: ExperimentRequest, source: str) -> None:
    """Refuse inputs beyond the limits: they are in another unit, or the limits were not enforced."""
    (lower, upper), rounding = request.bounds.input_bounds, RECORDED_ROUNDING * request.bounds.inputs
    beyond = np.argwhere((inputs < lower - rounding) | (inputs > upper + rounding))
    if len(beyond):
        row, column = beyond[0]
        quantity, given = request.task.inputs[column], inputs[row, column]
        above = given > upper[column]
        limit = f"at most {upper[column]:g}" if above else f"at least {lower[column]:g}"
        raise HardwareError(
            f"{source}: row {rows[row]}, column {quantity.name}: expected {limit} {quantity.unit}, "
            f"got {given:g}"
        )


def _check_changes(
    inputs: Array, times: Array, rows: Sequence[int], request: ExperimentRequest, source: str
) -> None:
    """Refuse inputs (k, m) that change by more than their limit from one frame to the next."""
    time_step = request.task.time_step
    limits, changes = request.bounds.input_rates * time_step, np.abs(np.diff(inputs, axis=0))
    beyond = np.argwhere(changes > limits * (1 + RECORDED_ROUNDING))
    if len(beyond):
        before, column = beyond[0]
        quantity, row = request.task.inputs[column], np.searchsorted(times, (before + 1 - JITTER) * time_step)
        raise HardwareError(
            f"{source}: row {rows[row]}, column {quantity.name}: expected a change by at most "
            f"{limits[column]:g} {quantity.unit} in a frame (hardware.safety.input_rates), "
            f"got {changes[before, column]:g}"
        )


def _means(times: Array, inputs: Array, wanted: Array) -> Array:
    """The means (k, m) of inputs held between times, from each wanted time to the next."""
    wanted = np.minimum(wanted, times[-1])  # the last row may be slightly early
    steps = np.diff(times)[:, None]
    sums = np.concatenate([np.zeros((1, inputs.shape[1])), np.cumsum(steps * inputs[:-1], axis=0)])
    at = np.stack([np.interp(wanted, times, column) for column in sums.T], axis=1)
    return np.diff(at, axis=0) / np.diff(wanted)[:, None]


def _ended(
    states: Array, inputs: Array, failure: str | None, last: Array, request: ExperimentRequest, end: str
) -> Rollout:
    """The rollout up to the first state that failed or was unsafe, or to the failure that the lab reports.

    A recording may end between two frames, at the `last` measured state (n,).
    """
    task = request.task
    unsafe = np.any(np.abs(states) > request.bounds.states, axis=1)
    acted = np.arange(len(states)) < task.horizon  # no input acts after the last, safe or not
    ends = np.flatnonzero((task.violated(states) >= 0) | (unsafe & acted))
    k = int(ends[0]) if len(ends) else len(inputs)
    if len(ends):
        failure = _exceeded(states[k], request)
    elif k < task.horizon:
        failure = _exceeded(last, request) or failure
    if failure is None and k < task.horizon:
        raise HardwareError(
            f"{end}: expected {task.horizon} frames of {task.time_step:g} s, but the recording ends after "
            f"{k} without a failure; if the robot failed, name how in its last row ({FAILURE})"
        )
    states, inputs = states[: k + 1], inputs[:k]
    return Rollout(states, inputs, None if failure is None else k, failure, measured=states, sensed=True)


def _exceeded(x: Array, request: ExperimentRequest) -> str | None:
    """The failure or unsafe state in x (n,), if any."""
    beyond = np.flatnonzero(np.abs(x) > request.bounds.states)
    unsafe = f"unsafe_state_{request.task.states[beyond[0]].name}" if len(beyond) else None
    return request.task.failure(x) or unsafe
