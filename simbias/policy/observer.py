"""State estimates for a policy, from measurements with noisy, late or missing rates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.linalg import block_diag, solve_discrete_are

from simbias.core import Nominal, Task, rates_and_positions, wrapped
from simbias.core.quantities import rate_pairs
from simbias.core.records import Array
from simbias.simulation.goal import holding
from simbias.simulation.linearization import input_scale, linearization
from simbias.simulation.noise import QUIET, Noise, Variances

ObserverKind = Literal["none", "filter", "derivative", "model", "kalman", "disturbance"]
LEAST = 0.02  # least gain of a filter
DISTURBANCE = 0.05  # process noise: deviation of unknown inputs in a frame, as a share of the limits;
# steady forces change by as much in a second
ELSEWHERE = 0.01  # its share that acts on each state separately, so that no direction is exact
MOST_AHEAD = 20  # frames of prediction
EXACT = 1e-6  # deviation assumed for noise-free measurements, in their unit


class Observer(ABC):
    """An estimate of the state, frame by frame; in the first frame, it is the measured state."""

    bounds: tuple[Array, Array] = (np.empty(0), np.empty(0))  # of its gains: lower (o,), upper (o,)
    copies: int = 0  # number of copies of the states in its own state
    frames_ahead: int = 0  # delay of the next input, as far as known

    def __init__(self, task: Task, nominal: Nominal, noise: Variances = QUIET) -> None:
        self._task, self._nominal, self._noise = task, nominal, noise
        self._is_rate = np.array([state.is_rate for state in task.states])
        self.size = self.copies * len(task.states)  # size of its own state

    @abstractmethod
    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The estimate (..., n) from measurements x (..., n), gains (..., o) and its own state (..., s)."""

    @abstractmethod
    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The observer's state (..., s) for the next frame, after the input u (..., m) was sent at t in s."""

    def ahead(self, estimate: Array, kept: Array) -> Array:
        """The state (..., n) when the next input acts, accounting for known delays."""
        return estimate

    @property
    def seconds_ahead(self) -> float:
        """How far the state of `ahead` is ahead of the time, in s."""
        return self.frames_ahead * self._task.time_step

    def designed_on(self, nominal: Nominal) -> Observer:
        """The observer designed on an identified model; itself if it uses no model or the declared one."""
        return self

    def _first(self, t: Any) -> Any:
        """Whether time t is in the first frame."""
        return t < 0.5 * self._task.time_step


class Measured(Observer):
    """The measured state as the estimate: no observer."""

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The measured state (..., n), unchanged."""
        return x

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """An empty state (..., 0): measurements need no memory."""
        return x[..., :0]


class RateFilter(Observer):
    """r <- r + alpha (v - r): a low-pass filter of the measured rates v."""

    bounds = (np.array([LEAST]), np.array([1.0]))
    copies = 1

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The state with filtered rates."""
        return np.where(self._first(t), x, kept + np.where(self._is_rate, gains, 1.0) * (x - kept))

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The estimate (..., n)."""
        return estimate


class RatesOfPositions(Observer):
    """r <- r + alpha (dq / dt - r): differences of positions, filtered.

    Measured rates are used only in the first frame: a robot that measures none sends zeros.

    ValueError if a task lacks a rate, in its unit per second, for one of the other states.
    """

    bounds = (np.array([LEAST]), np.array([1.0]))
    copies = 2

    def __init__(self, task: Task, nominal: Nominal, noise: Variances = QUIET) -> None:
        super().__init__(task, nominal, noise)
        rates, positions = rates_and_positions(task.states)
        self._source = np.arange(len(task.states))
        self._source[rates] = positions  # for each state: the index of the state whose difference counts
        self._quantities = [task.states[index] for index in self._source]

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The state with rates of its positions."""
        before, rates = kept[..., : self.size // 2], kept[..., self.size // 2 :]
        moved = wrapped((x - before)[..., self._source], self._quantities) / self._task.time_step
        return np.where(self._first(t) | ~self._is_rate, x, rates + gains * (moved - rates))

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The measured state and the estimate, concatenated (..., 2n)."""
        return np.concatenate([x, estimate], axis=-1)


class ModelObserver(Observer):
    """x^ <- f'(x^, u) + gains (x - f'(x^, u)), f' the nominal model: one gain for positions, one for rates.

    It is like a Kalman filter of the declared model, but its gains are searched, not computed from variances.
    """

    bounds = (np.array([LEAST, LEAST]), np.array([1.0, 1.0]))
    copies = 1

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The prediction, corrected by the measurement."""
        gain = np.where(self._is_rate, gains[..., 1:], gains[..., :1])
        return np.where(self._first(t), x, kept + gain * wrapped(x - kept, self._task.states))

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The prediction of the next state."""
        return self._nominal.step(estimate, u)


class KalmanFilter(Observer):
    """x^ <- x- + L (x - x-), x- = f'(x^, u): a stationary Kalman filter of the (identified) nominal model.

    L is the gain for the model linearised at the goal, or at the mean start if the goal does not cover all
    states, under the inputs that hold it there, with sliding joints (R. E. Kalman, J. Basic Eng. 82, 1960).
    The model state, such as delayed inputs, is known: it follows from the sent inputs. If inputs are delayed,
    the policy acts on the state when its input will act: `frames_ahead` frames later, predicted from the
    inputs already sent.

    Where a model lacks a force, such as wind, predictions are off, and so are estimates. With `disturbances`,
    unknown accelerations that change slowly are further states, so that a steady one leaves no error
    (U. Maeder, F. Borrelli, M. Morari, Automatica 45, 2009). A learned bias is not part of the model here.

    ValueError if the model has no stationary filter there.
    """

    def __init__(
        self, task: Task, nominal: Nominal, noise: Variances = QUIET, disturbances: bool = False
    ) -> None:
        super().__init__(task, nominal, noise)
        self._disturbed, self._n = disturbances, len(task.states)
        try:
            x, self._holding = self._balance()
            A, W = self._linear(x)
            self._effects, walk = self._accelerations(W)  # E (n, r): of unknown accelerations in a frame
            self.gain = self._stationary(A, W, walk)  # L (n + r, n)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ValueError(
                f"observer: the nominal model has no Kalman filter at the goal: {error}"
            ) from error
        self.size = self._n + nominal.state_size + len(walk)
        self.frames_ahead = self._delay()

    def _linear(self, x: Array) -> tuple[Array, Array]:
        """The linear model A (n, n) at states x (n,), and the covariance W (n, n) of its noise in a frame."""
        limit = input_scale(self._task)
        A, B = linearization(self._nominal.without_dry_friction(), x, self._holding, limit)
        by_inputs = (DISTURBANCE * limit * B) @ (DISTURBANCE * limit * B).T
        return A, by_inputs + ELSEWHERE**2 * np.diag(np.diag(by_inputs)) + EXACT**2 * np.eye(len(A))

    def _accelerations(self, W: Array) -> tuple[Array, Array]:
        """Effects (n, r) of unknown accelerations in a frame, and variances (r,) of their change in it.

        There is one for each rate that has a position. Those of one unit are alike; none is assumed where no
        input acts on a rate of that unit.
        """
        states, dt = self._task.states, self._task.time_step
        pairs = rate_pairs(states) if self._disturbed else []
        by_inputs, largest = np.sqrt(np.diag(W)) / dt, dict[str, float]()  # accelerations by unknown inputs
        for _, rate in pairs:
            unit = states[rate].unit
            largest[unit] = max(by_inputs[rate], largest.get(unit, 0.0))
        pairs = [(i, rate) for i, rate in pairs if largest[states[rate].unit] > 2 * EXACT / dt]
        if self._disturbed and not pairs:
            raise ValueError("no input acts on a rate that has a position, so no disturbance is estimated")
        effects = np.zeros((self._n, len(pairs)))
        for column, (position, rate) in enumerate(pairs):
            effects[[position, rate], column] = dt**2 / 2, dt
        return effects, np.array([dt * largest[states[rate].unit] ** 2 for _, rate in pairs])

    def _stationary(self, A: Array, W: Array, walk: Array) -> Array:
        """The gain (n + r, n) of the innovation."""
        n, r = self._n, len(walk)
        F = np.block([[A, self._effects], [np.zeros((r, n)), np.eye(r)]])
        V = np.diag(np.maximum(Noise(self._task, self._noise).sensor_variance, EXACT**2))
        P = solve_discrete_are(F.T, np.eye(n + r, n), block_diag(W, np.diag(walk)), V)
        return np.linalg.solve(P[:n, :n] + V, P[:n]).T

    def _balance(self) -> tuple[Array, Array]:
        """The states (n,) to linearise at, and the inputs (m,) that hold them."""
        task = self._task
        at_goal, end = task.goals == task.states, task.horizon * task.time_step
        x = np.broadcast_to(task.reference(end) if at_goal else task.start_mean, (len(task.states),))
        return x, holding(task, self._nominal, x)

    def _delay(self) -> int:
        """Frames until more than half of an input acts; 0 if inputs have no effect."""
        nominal, limit = self._nominal, input_scale(self._task)
        x, model_state = np.zeros((2, self._n)), np.zeros((2, nominal.state_size))
        u = np.stack([limit, 0.0 * limit])
        at_once = np.abs(np.subtract(*nominal.step(x, u))).sum()
        if not at_once:  # such as a model of positions and rates alone
            return 0
        for frames in range(MOST_AHEAD):
            moved, model_state = nominal.advance(x, u, model_state)
            if np.abs(np.subtract(*moved)).sum() > 0.5 * at_once:
                return frames
        return MOST_AHEAD

    def designed_on(self, nominal: Nominal) -> KalmanFilter:
        """The filter designed on another model."""
        return KalmanFilter(self._task, nominal, self._noise, self._disturbed)

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The prediction, corrected by the measurement."""
        n = self._n
        return np.where(self._first(t), x, kept[..., :n] + self._correction(self.gain[:n], x, kept))

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The prediction of the next state, the model state and unknown accelerations (..., n + h + r)."""
        _, model_state, unknown = self._parts(kept)
        if self._disturbed:
            learned = self._correction(self.gain[self._n :], x, kept)
            unknown = unknown + np.where(self._first(t), 0.0, learned)
        x_next, model_state = self._advanced(estimate, u, model_state, unknown)
        return np.concatenate([x_next, model_state, unknown], axis=-1)

    def ahead(self, estimate: Array, kept: Array) -> Array:
        """The state (..., n) after the frames in which the inputs already sent act."""
        _, model_state, unknown = self._parts(kept)
        u = 0.0 * estimate[..., : len(self._task.inputs)]
        if self._holding.any():  # of the next input, part may act meanwhile, if its delay is no whole frame
            u = u + self._holding
        for _ in range(self.frames_ahead):
            estimate, model_state = self._advanced(estimate, u, model_state, unknown)
        return estimate

    def _parts(self, kept: Array) -> tuple[Array, Array, Array]:
        """Predicted state (..., n), model state (..., h) and unknown accelerations (..., r)."""
        n, h = self._n, self._nominal.state_size
        return kept[..., :n], kept[..., n : n + h], kept[..., n + h :]

    def _correction(self, gain: Array, x: Array, kept: Array) -> Array:
        """A gain (k, n) times the innovation: (..., k)."""
        innovation = wrapped(x - kept[..., : self._n], self._task.states)
        return (gain @ innovation[..., None])[..., 0]

    def _advanced(self, x: Array, u: Array, model_state: Array, unknown: Array) -> tuple[Array, Array]:
        """State (..., n) and model state (..., h) a frame later, under unknown accelerations (..., r)."""
        x_next, model_state = self._nominal.advance(x, u, model_state)
        if self._disturbed:
            x_next = x_next + (self._effects @ unknown[..., None])[..., 0]
        return x_next, model_state


class LookAhead(Observer):
    """The estimate of another observer, extrapolated by the latency of measurements in s.

    The state is x + (latency / dt) (f'(x, u) - x), with f' the declared nominal model and u the mean of the
    inputs sent in this time: one stretched step, whatever the latency.

    ValueError if the latency exceeds 20 frames.
    """

    def __init__(self, task: Task, nominal: Nominal, observer: Observer, latency: float) -> None:
        super().__init__(task, nominal)
        most = MOST_AHEAD * task.time_step
        if latency > most:
            raise ValueError(f"latency: expected at most {MOST_AHEAD} frames, {most:g} s, got {latency:g} s")
        self._observer, self.bounds = observer, observer.bounds
        self._latency, self._inputs = latency, task.frames(latency)
        self.size = observer.size + self._inputs * len(task.inputs)

    @property
    def seconds_ahead(self) -> float:
        """The latency, and how far the other observer looks ahead, in s."""
        return self._observer.seconds_ahead + self._latency

    def designed_on(self, nominal: Nominal) -> LookAhead:
        """The same extrapolation, with the other observer designed on this model."""
        own = self._observer.designed_on(nominal)
        return self if own is self._observer else LookAhead(self._task, self._nominal, own, self._latency)

    def estimate(self, gains: Array, x: Array, t: Any, kept: Array) -> Array:
        """The other observer's estimate, at the time of measurement."""
        return self._observer.estimate(gains, x, t, kept[..., : self._observer.size])

    def keep(self, x: Array, estimate: Array, u: Array, t: Any, kept: Array) -> Array:
        """The other observer's state, and the sent inputs, oldest first."""
        own, sent = kept[..., : self._observer.size], kept[..., self._observer.size :]
        m = len(self._task.inputs)
        own = self._observer.keep(x, estimate, sent[..., :m], t, own)  # the input that acted after x
        return np.concatenate([own, sent[..., m:], u], axis=-1)

    def ahead(self, estimate: Array, kept: Array) -> Array:
        """The state (..., n) when the next input acts."""
        m, sent = len(self._task.inputs), kept[..., self._observer.size :]
        u = sum((sent[..., i * m : (i + 1) * m] for i in range(self._inputs)), 0.0 * sent[..., :m])
        ahead = self._observer.ahead(estimate, kept[..., : self._observer.size])
        moved = self._nominal.step(ahead, u / self._inputs) - ahead
        return ahead + self._latency / self._task.time_step * moved


OBSERVERS: dict[ObserverKind, Callable[[Task, Nominal, Variances], Observer]] = {
    "none": Measured,
    "filter": RateFilter,
    "derivative": RatesOfPositions,
    "model": ModelObserver,
    "kalman": KalmanFilter,
    "disturbance": partial(KalmanFilter, disturbances=True),
}
