"""Actuators between the commanded input and the acting input: gain, limit, lag, delay and offset.

    u_acts = offset + lag(limited(gain u(t - delay)))

The kernels below put actuators in front of any robot's kernel, in the lanes of vector registers. Their model
state is zero at the start, as nothing was commanded before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from simbias.core import Kernel
from simbias.core.records import Array
from simbias.simulation.compiler import at_least, at_most, elementwise, function_of, sum_of

MOST_TAPS = 100  # frames of delay that a model may remember


class Actuator(NamedTuple):
    """Parameters of an input's actuator; by default, the input acts as commanded."""

    gain: float = 1.0
    offset: float = 0.0  # in the input's unit, like the limit
    limit: float = math.inf
    lag: float = 0.0  # s, the time constant of a first-order lag
    delay: float = 0.0  # s


def taps_of(delay: float, time_step: float) -> int:
    """The number of earlier inputs needed for delays up to `delay` s; ValueError if it is too large."""
    taps = math.ceil(delay / time_step - 1e-9)
    if taps > MOST_TAPS:
        raise ValueError(f"a delay of up to {delay:g} s is {taps} frames; at most {MOST_TAPS} are possible")
    return taps


class Actuators:
    """The actuators of all inputs of a robot, whose delays are at most `taps` frames.

    The acting input is continuous in lag and delay. If `averaged`, its value in a frame is the mean over the
    frame, as for a real motor; this is exact for inputs that are constant in each frame. Otherwise it is the
    value at the end of the frame; if the delay contains a fraction of a frame, the input is first
    interpolated between adjacent frames.
    """

    def __init__(
        self, actuators: Sequence[Actuator], time_step: float, taps: int, averaged: bool = False
    ) -> None:
        self._taps = taps
        keep = [math.exp(-time_step / a.lag) if a.lag > 0 else 0.0 for a in actuators]
        means = [a.lag / time_step * (1.0 - k) for a, k in zip(actuators, keep, strict=True)]
        before = means if averaged else keep
        frames = [min(round(a.delay / time_step, 9), taps) for a in actuators]
        weights = np.maximum(0.0, 1.0 - np.abs(np.array(frames)[:, None] - np.arange(taps + 1)))
        ends = weights.copy()
        for i, a in enumerate(actuators if averaged else []):
            if a.lag > 0:
                ends[i], weights[i] = _weights(frames[i], a.lag / time_step, taps)
        columns = [[a.gain, a.offset, a.limit] for a in actuators]
        self._parameters = np.column_stack([columns, keep, before, ends, weights])  # (m, 7 + 2 taps)
        self.state_size = len(actuators) * (1 + taps)
        self.ideal = all(actuator == Actuator() for actuator in actuators)
        self.kernel = Kernel(_act(len(actuators), taps), self._parameters.ravel())

    def before(self, mechanics: Kernel) -> Kernel:
        """The kernel of these actuators, with their model state, in front of a nominal model without one."""
        act = self.kernel
        function = _composed(act.function, len(act.parameters), mechanics.function)
        return Kernel(function, np.concatenate([act.parameters, mechanics.parameters]))

    def settled(self, u: Array) -> Array:
        """The acting input (..., m) in steady state when u (..., m) is commanded."""
        gain, offset, limit = self._parameters[:, :3].T
        return limited(gain * u, limit) + offset

    def acting(self, u: Array, model_state: Array) -> tuple[Array, Array]:
        """The acting input (..., m) when u (..., m) is commanded, and the next model state (..., s)."""
        m, act = len(self._parameters), self.kernel.function

        def both(u, model_state, parameters):
            acting, kept = act(u, parameters, model_state)
            return (*acting, *kept)

        rows = elementwise(both, u, model_state, parameters=self.kernel.parameters)
        return rows[..., :m], rows[..., m:]

    def model_states(self, inputs: Array) -> Array:
        """Model state (k, s) in each frame of a record of inputs (k, m), from its start."""
        from scipy.signal import lfilter  # would take half of the time of `import simbias`, and few need it

        k, columns = len(inputs), []
        for u, (gain, _, limit, keep, _, *weights) in zip(inputs.T, self._parameters, strict=True):
            delayed = np.convolve(u, weights[: 1 + self._taps])[:k] if k else u
            lagged = lfilter([1.0 - keep], [1.0, -keep], limited(gain * delayed, limit))
            columns += [_earlier(lagged, 1), *(_earlier(u, j) for j in range(1, self._taps + 1))]
        return np.stack(columns, axis=-1)


def _weights(delay: float, lag: float, taps: int) -> tuple[Array, Array]:
    """Weights (1 + taps,) of current and earlier inputs: in the lag's state after a frame, and in its mean.

    Delay and lag are in frames. During the fractional part of the delay, the previous frame's input still
    acts.
    """
    whole = int(delay)
    fraction = delay - whole
    kept, since = math.exp(-1.0 / lag), math.exp((fraction - 1.0) / lag)
    ends, means = np.zeros(2 + taps), np.zeros(2 + taps)
    reached = np.array([1.0 - since, since - kept])  # by this input and the one before, at the end
    ends[whole : whole + 2] = reached / (1.0 - kept)
    means[whole : whole + 2] = ([1.0 - fraction, fraction] - lag * reached) / (1.0 - lag * (1.0 - kept))
    return ends[:-1], means[:-1]


def limited(x, limit):
    """Clip numbers or arrays x to +-limit."""
    return at_most(at_least(x, -limit), limit)


def _earlier(values: Array, frames: int) -> Array:
    """Values (k,) shifted later by this number of frames, zero before the first."""
    return np.concatenate([np.zeros(frames), values])[: len(values)]


@lru_cache(maxsize=64)
def _act(inputs: int, taps: int, first: int = 0) -> Callable:
    """The actuator kernel of the inputs from number `first` on.

    The parameters of each input are: gain, offset, limit, the share of the lag's state kept per frame, the
    weight of that state in the acting input, and the weights of current and earlier inputs, in the lag's
    state and in the acting input. The model state is the lag's state and the earlier inputs.
    """
    if first == inputs:
        return lambda u, parameters, model_state: ((), ())
    others = _act(inputs, taps, first + 1)
    p, s = first * (7 + 2 * taps), first * (1 + taps)
    earlier, oldest = s + 1, s + taps
    at_end, of_mean = (_weighted(p + 5 + own * (1 + taps), first, earlier, taps) for own in (0, 1))

    def act(u, parameters, model_state):
        """The acting inputs, and the model state for the next frame."""
        gain, limit, keep, before = parameters[p], parameters[p + 2], parameters[p + 3], parameters[p + 4]
        target = limited(gain * at_end(u, parameters, model_state), limit)
        mean = limited(gain * of_mean(u, parameters, model_state), limit)
        lagged = keep * model_state[s] + (1.0 - keep) * target
        acts = before * model_state[s] + (1.0 - before) * mean
        acting, kept = others(u, parameters, model_state)
        inputs_before = ((u[first],) + model_state[earlier:oldest])[:taps]  # noqa: RUF005 (for Numba)
        return (acts + parameters[p + 1],) + acting, (lagged,) + inputs_before + kept  # noqa: RUF005

    return act


def _weighted(first: int, number: int, earlier: int, taps: int) -> Callable:
    """The weighted sum of current and earlier inputs; weights begin at parameter `first`."""
    terms = [f"parameters[{first + 1 + j}] * model_state[{earlier + j}]" for j in range(taps)]
    sums = f"parameters[{first}] * u[{number}] + ({sum_of(terms)})"
    return function_of(f"def weighted(u, parameters, model_state): return {sums}", "weighted")


@lru_cache(maxsize=64)
def _composed(act: Callable, count: int, step: Callable) -> Callable:
    """The kernel of actuators in front of a robot's; the first `count` parameters are the actuators'."""

    def advance(x, u, parameters, model_state):
        """x_next, and the model state for the next frame."""
        acting, kept = act(u, parameters, model_state)
        return step(x, acting, parameters[count:]), kept

    return advance
