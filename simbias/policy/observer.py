"""Estimates of the state for a policy, from measurements whose rates are noisy, late or missing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

import numpy as np

from simbias.core import Nominal, Task, rates_and_positions, wrapped
from simbias.core.records import Array

ObserverKind = Literal["none", "filter", "derivative", "model"]
LEAST = 0.02  # gain of a filter


class Observer(ABC):
    """An estimate of the state, frame by frame; in the first frame, it is what is measured."""

    bounds: tuple[Array, Array] = (np.empty(0), np.empty(0))  # of its parameters: lower (o,), upper (o,)
    size: int = 0  # of its state

    def __init__(self, task: Task, nominal: Nominal) -> None:
        self._task, self._nominal = task, nominal
        self._is_rate = np.array([state.is_rate for state in task.states])

    @abstractmethod
    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The state (..., n) of what is measured, x (..., n); gains (..., o), its state (..., s)."""

    @abstractmethod
    def keep(self, x: Array, estimate: Array, u: Array) -> Array:
        """The observer's state (..., s) for the next frame, given the input u (..., m) that is sent."""

    def _first(self, t: Any) -> Any:
        """Whether time t is in the first frame."""
        return t < 0.5 * self._task.time_step


class Measured(Observer):
    """The measured state as the estimate: no observer."""

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The measured state (..., n), unchanged."""
        return x

    def keep(self, x: Array, estimate: Array, u: Array) -> Array:
        """An empty state (..., 0): measurements need no memory."""
        return x[..., :0]


class RateFilter(Observer):
    """r <- r + alpha (v - r): a low-pass filter of the measured rates v."""

    bounds = (np.array([LEAST]), np.array([1.0]))

    def __init__(self, task: Task, nominal: Nominal) -> None:
        super().__init__(task, nominal)
        self.size = len(task.states)

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The state with filtered rates."""
        return np.where(self._first(t), x, kept + np.where(self._is_rate, gains, 1.0) * (x - kept))

    def keep(self, x: Array, estimate: Array, u: Array) -> Array:
        """The estimate (..., n)."""
        return estimate


class RatesOfPositions(Observer):
    """r <- r + alpha (dq / dt - r): differences of positions, filtered; measured rates are not used.

    Raises
    ------
    ValueError
        If a task has not as many rates as other states: they are taken in the same order.
    """

    bounds = (np.array([LEAST]), np.array([1.0]))

    def __init__(self, task: Task, nominal: Nominal) -> None:
        super().__init__(task, nominal)
        rates, positions = rates_and_positions(task.states)
        self._source = np.arange(len(task.states))
        self._source[rates] = positions  # of each state, the one whose difference counts
        self._quantities = [task.states[index] for index in self._source]
        self.size = 2 * len(task.states)

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The state with rates of its positions."""
        before, rates = kept[..., : self.size // 2], kept[..., self.size // 2 :]
        moved = wrapped((x - before)[..., self._source], self._quantities) / self._task.time_step
        return np.where(self._first(t) | ~self._is_rate, x, rates + gains * (moved - rates))

    def keep(self, x: Array, estimate: Array, u: Array) -> Array:
        """The measured state and the estimate, concatenated (..., 2n)."""
        return np.concatenate([x, estimate], axis=-1)


class ModelObserver(Observer):
    """x^ <- f'(x^, u) + gains (x - f'(x^, u)), f' the nominal model: one gain of positions, one of rates.

    It is a Kalman filter whose gains are searched rather than computed of variances.
    """

    bounds = (np.array([LEAST, LEAST]), np.array([1.0, 1.0]))

    def __init__(self, task: Task, nominal: Nominal) -> None:
        super().__init__(task, nominal)
        self.size = len(task.states)

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The prediction, corrected by what is measured."""
        gain = np.where(self._is_rate, gains[..., 1:], gains[..., :1])
        return np.where(self._first(t), x, kept + gain * wrapped(x - kept, self._task.states))

    def keep(self, x: Array, estimate: Array, u: Array) -> Array:
        """The prediction of the next state."""
        return self._nominal.step(estimate, u)


OBSERVERS: dict[ObserverKind, type[Observer]] = {
    "none": Measured,
    "filter": RateFilter,
    "derivative": RatesOfPositions,
    "model": ModelObserver,
}
