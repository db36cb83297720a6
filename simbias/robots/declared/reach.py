"""Whether a task can succeed at all: states that meet its conditions, sought by damped least squares.

All searches run in one batch: one by one, SciPy's take tens of times as long.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from simbias.core import StudyWarning, Task
from simbias.core.records import Array
from simbias.core.task_checks import drawn_starts
from simbias.robots.declared.success import Success

TIMES, STARTS = 8, 24  # times, or drawn targets, for which states are sought; starts of each search
FEW = 3  # of both, where expressions use a MuJoCo model's sensors, which takes a thousand times as long
MAGNITUDES = 0.0, 2.5  # of the starts' deviations from drawn ones, decimal logarithms in the states' units
STEPS = 200  # of a search
NEARER = 0.9  # of what the worst start lacks: a search has come nearer
SLOPE_STEP = 1e-6  # relative to a state, 1 at least
SLIGHT = 1e-6  # of what a state lacks, relative to the limit: nothing
DAMPING, LEAST_DAMPING = 4.0, 1e-9  # of a search's steps: factor, down if a step helps, else up; the least
TINY = 1e-12  # of the square of slopes: a search without any stays where it is


def warn_out_of_reach(task: Task, success: Success, seen: Callable[[Array], Array], slow: bool) -> None:
    """Warn if no state was found that meets the conditions at some time, or for some drawn targets.

    `seen` maps states (k, n) to the states and sensor values that conditions use. Nothing is said if searches
    do not come nearer, such as to a narrow bell from afar.
    """
    cases, count = (FEW, FEW) if slow else (TIMES, STARTS)
    last, free = success.times(task), len(task.states) - len(task.targets)
    at = np.full(cases, len(last) - 1) if task.targets else np.linspace(0, len(last) - 1, cases, dtype=int)
    t, starts = last[at], _starts(task, cases, count)
    limits = np.array([criterion.limit for criterion in task.criteria])
    slight = SLIGHT * _sizes(np.concatenate([success.limits, limits]))

    def error(x: Array) -> Array:
        return task.error(x, np.repeat(t, len(x) // len(t)))

    def lacking(x: Array) -> Array:
        short = success.lacking(seen(x), np.repeat(t, len(x) // len(t)), error(x))
        passed = short + 2 * slight[: short.shape[1]]  # limits are passed, not only reached
        return np.maximum(np.concatenate([passed, task.measure(x) - limits], axis=1), 0.0)

    def of_all(x: Array) -> Array:
        return lacking(x.reshape(-1, x.shape[-1])).reshape(*x.shape[:2], -1)

    with np.errstate(all="ignore"):
        x = nearest(lacking, np.concatenate([starts, nearest(error, starts, free)], axis=1), free, slight)
        before, lack = _finite(of_all(starts)).max(axis=1), of_all(x)  # (cases, c), (cases, s, c)
    best = range(cases), _largest(lack / slight).argmin(axis=1)
    x, lack = x[best], lack[best]
    short = lack > slight
    missed = np.flatnonzero(short.any(axis=1) & (~short | (lack < NEARER * before)).all(axis=1))
    if not missed.size:
        return
    first = missed[:1]
    how = success.missed_by(seen(x[first]), t[first], task.error(x[first], t[first]))
    how = how or f"the task fails ({task.failure(x[first][0])})"
    which = f" for {missed.size} of {cases} drawn targets" if task.targets else ""
    words = f"success seems out of reach{which}: in the nearest state found, {how} at t = {t[first][0]:.3g} s"
    warnings.warn(words, StudyWarning, stacklevel=5)


def _starts(task: Task, cases: int, count: int) -> Array:
    """Starts (cases, count, n): the mean, a few drawn ones, and others far from these; targets by case."""
    rng, robot = np.random.default_rng(0), len(task.states) - len(task.targets)
    drawn = drawn_starts(task, rng)
    starts = np.tile(drawn[:count], (cases, 1, 1))
    starts[:, 0] = task.start_mean
    far = starts[:, count // 3 :]
    far += rng.choice([-1.0, 1.0], far.shape) * 10.0 ** rng.uniform(*MAGNITUDES, far.shape)
    starts[:, :, robot:] = drawn[:cases, None, robot:]
    return starts


def nearest(
    residuals: Callable[[Array], Array], starts: Array, free: int, slight: Array | float = SLIGHT
) -> Array:
    """States (k, s, n) that reduce the squares of residuals, from starts (k, s, n) of k cases.

    `residuals` maps states (k s r, n), case by case, to (k s r, c). Only the first `free` states change. The
    search ends once each case has a state whose residuals are at most `slight` (c,).
    """
    x = starts.reshape(-1, starts.shape[-1]).copy()
    damping, r = np.full(len(x), 1e-3), residuals(x)
    for _ in range(STEPS):
        if (_largest(r / slight).reshape(len(starts), -1).min(axis=1) <= 1.0).all():
            break
        J = _slopes(residuals, x, free)
        square, downhill = J.transpose(0, 2, 1) @ J, J.transpose(0, 2, 1) @ _finite(r)[:, :, None]
        sizes = np.trace(square, axis1=1, axis2=2)
        square += np.maximum(damping * sizes, TINY)[:, None, None] * np.eye(free)
        moved = x.copy()
        try:
            moved[:, :free] -= np.linalg.solve(square, downhill)[:, :, 0]
        except np.linalg.LinAlgError:  # slopes so steep that squares overflow
            break
        after = residuals(moved)
        nearer = _total(after) < _total(r)
        x[nearer], r[nearer] = moved[nearer], after[nearer]
        damping = np.clip(damping * np.where(nearer, 1 / DAMPING, DAMPING), LEAST_DAMPING, None)
    return x.reshape(starts.shape)


def _sizes(limits: Array) -> Array:
    """Sizes (c,) of limits (c,), relative to which what states lack is slight; 1 where a limit is 0."""
    return np.where(limits == 0.0, 1.0, np.abs(limits))


def _slopes(residuals: Callable[[Array], Array], x: Array, free: int) -> Array:
    """Slopes (k, c, free) of the residuals at states (k, n), by central differences."""
    steps = np.zeros((len(x), 2 * free, x.shape[1]))
    sizes = SLOPE_STEP * np.maximum(np.abs(x[:, :free]), 1.0)
    steps[:, range(free), range(free)], steps[:, range(free, 2 * free), range(free)] = sizes, -sizes
    around = residuals((x[:, None] + steps).reshape(-1, x.shape[1])).reshape(len(x), 2, free, -1)
    return _finite((around[:, 0] - around[:, 1]) / (2 * sizes[:, :, None])).transpose(0, 2, 1)


def _finite(values: Array) -> Array:
    """Values with zeros in place of what is not finite."""
    return np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)


def _largest(r: Array) -> Array:
    """The largest magnitude (...) of residuals (..., c); inf if one is no number."""
    return np.nan_to_num(np.abs(r), nan=np.inf, posinf=np.inf).max(axis=-1, initial=0.0)


def _total(r: Array) -> Array:
    """The sum (k,) of the squares of residuals (k, c); inf if one is no number."""
    return np.nan_to_num((r**2).sum(axis=1), nan=np.inf, posinf=np.inf)
