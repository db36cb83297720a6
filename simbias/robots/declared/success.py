"""The success conditions of a declared task."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from simbias.core import Quantity, StudyWarning, Task
from simbias.core.records import Array
from simbias.robots.declared.declarations import Failure, bound_of, criterion_of, within_abs
from simbias.robots.declared.reference import TIME
from simbias.simulation.compiler import Expressions


class Success:
    """Success conditions that must hold for the last seconds of an episode.

    Besides states, expressions may use time t and `<name>_error` of each goal quantity.
    """

    def __init__(
        self, conditions: Mapping[str, Failure], measures: Expressions, frames: int, seconds: float
    ) -> None:
        self._conditions = conditions
        limits = [criterion_of(name, each, ()).limit for name, each in conditions.items()]
        self.limits = np.array(limits)  # (c,), which the measures must exceed
        self._measures = measures
        self._frames, self._seconds = frames, seconds

    def check_at(self, goal: Array) -> None:
        """Refuse conditions on errors and time alone that do not hold at zero error.

        The rows (k, .) have the times of the last frames and zero errors; states, which the goal may not
        determine, are nan.
        """
        least = self._measures(goal).min(axis=0)
        for (name, each), value, limit in zip(self._conditions.items(), least, self.limits, strict=True):
            if value <= limit:
                there = f"{each.value} is {_beside_bound(each, value, limit)} at the goal"
                raise ValueError(f"success.{name} cannot hold: {there}")

    def check_beside(self, failures: Mapping[str, Failure]) -> None:
        """Refuse conditions on an expression or its `abs` that contradict each other or failure criteria."""
        own = {f"success.{name}": each for name, each in self._conditions.items()}
        keyed = own | {f"failure.{name}": each for name, each in failures.items()}
        together = defaultdict[str, list[str]](list)
        for key, each in keyed.items():
            together[within_abs(each.value)[0]].append(key)
        for expression, keys in together.items():
            ends = np.unique([(0.0, bound_of(keyed[key]), -bound_of(keyed[key])) for key in keys])
            values = np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, 2 * ends[[0, -1]] + [-1.0, 1.0]])
            met = [(_margin(keyed[key], values) > 0) == (key in own) for key in keys]
            if keys[0] in own and not np.all(met, axis=0).any():
                kept, avoided = ([key for key in keys if (key in own) == is_own] for is_own in (True, False))
                words = " and ".join(kept) + (" without " + " or ".join(avoided)) * bool(avoided)
                raise ValueError(f"success cannot hold: no value of {expression} meets {words}")

    def warn_of_degrees(self, goals: Sequence[Quantity]) -> None:
        """Warn of a bound on the magnitude of an angle's error that no error exceeds."""
        most = {f"{goal.name}_error": goal.turn / 2 for goal in goals if goal.wraps and goal.unit == "rad"}
        for name, each in self._conditions.items():
            value, is_magnitude = within_abs(each.value)
            if is_magnitude and value in most and (each.below or 0.0) > most[value]:
                words = f"success.{name} always holds: {each.value} is at most {most[value]:.3g}"
                warnings.warn(f"{words}; is {each.below:g} in degrees?", StudyWarning, stacklevel=4)

    def check_numbers(self, states: Array, times: Array, errors: Array) -> None:
        """Refuse conditions that are not a number in any of these states (k, .)."""
        measures = self._measures(_rows_of(states, times, errors))
        for name, each in zip(self._conditions, measures.T, strict=True):
            if np.isnan(each).all():
                raise ValueError(f"success.{name} is not a number in any of {len(states)} states")

    def holds(self, states: Array, times: Array, errors: Array) -> bool:
        """Whether an episode of states (T+1, .) at times (T+1,), with errors (T+1, g), succeeds."""
        return bool((self._least(states, times, errors) > self.limits).all())

    def share(self, states: Array, times: Array, errors: Array) -> float:
        """The share of an episode's frames in which all conditions hold."""
        return float((self._measures(_rows_of(states, times, errors)) > self.limits).all(axis=1).mean())

    def shortfalls(self, states: Array, times: Array, errors: Array) -> Array:
        """How far (T+1, k) each frame is from the limits of the conditions that an episode misses."""
        short = np.maximum(self.lacking(states, times, errors), 0.0)
        return short[:, ~(self._least(states, times, errors) > self.limits)]

    def lacking(self, states: Array, times: Array, errors: Array) -> Array:
        """By how much (k, c) states (k, .) at times (k,), with errors (k, g), miss each condition's limit."""
        lacking: Array = self.limits - self._measures(_rows_of(states, times, errors))
        return lacking

    def times(self, task: Task) -> Array:
        """The times in s of an episode's last frames, in which the conditions must hold."""
        frames = np.arange(task.horizon + 1, dtype=np.float64)
        return task.time_step * frames[-self._frames :]

    def missed(self, states: Array, times: Array, errors: Array) -> str:
        """The conditions that do not hold in the last seconds, with the values furthest from their bounds."""
        last = (each[-self._frames :] for each in (states, times, errors))
        return f"in its last {self._seconds:g} s {self.missed_by(*last)}"

    def missed_by(self, states: Array, times: Array, errors: Array) -> str:
        """The conditions that do not hold in all these rows, with the values furthest from their bounds."""
        least = self._measures(_rows_of(states, times, errors)).min(axis=0)
        missed = []
        for (name, each), value, limit in zip(self._conditions.items(), least, self.limits, strict=True):
            if not value > limit:
                missed.append(f"{name} is {_beside_bound(each, value, limit)}")
        return "; ".join(missed)

    def _least(self, states: Array, times: Array, errors: Array) -> Array:
        """The least of each measure in the last frames."""
        least: Array = self._measures(_rows_of(states, times, errors)[-self._frames :]).min(axis=0)
        return least


def success_names(states: Sequence[str], goals: Sequence[Quantity]) -> list[str]:
    """The variables of success expressions, in the order of `Success.holds`."""
    return [*states, TIME, *(f"{goal.name}_error" for goal in goals)]


def _margin(condition: Failure, values: Array) -> Array:
    """By how much (k,) the expression of a condition, or that within its `abs`, meets it at these values."""
    given = np.abs(values) if within_abs(condition.value)[1] else values
    return (given - bound_of(condition)) * (1.0 if condition.below is None else -1.0)


def _rows_of(states: Array, times: Array, errors: Array) -> Array:
    """The variables (T+1, .) of success expressions, frame by frame."""
    return np.concatenate([states, times[:, None], errors], axis=1)


def _beside_bound(condition: Failure, measure: float, limit: float) -> str:
    """A measure and the limit that it does not exceed, in the words of the condition."""
    side, sign = ("above", 1) if condition.below is None else ("below", -1)
    value = f"{sign * measure + 0.0:.3g} {condition.unit}".strip()
    return f"{value}, not {side} {sign * limit:g}"
