"""Predictions of recorded experiments under their recorded inputs, many models in lockstep.

Every experiment is one long pass. At the beginning of each window the state is reset to the recorded one,
possibly smoothed; the model state continues. The results are means over chunks of successive frames: they
condense the information of single noisy frames into fewer numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from simbias.core import FittedBias, Kernel, Nominal
from simbias.core.records import Array, Flags, Indices, Rollout
from simbias.simulation.compiler import (
    Function,
    compile_open_loop,
    constant,
    in_threads,
    of_bias,
    of_nominal,
    points_among,
)

REST = 1e-9  # of a state's standard deviation: residue of interpolation for an encoder at rest
SOME = 5  # frames used to test whether a model remembers states


@dataclass(frozen=True, eq=False)
class Windows:
    """Recorded experiments, cut into w windows of `window` frames, each into J chunks of `chunk` frames.

    Windows are counted from the end, so that the last frames, where a falling robot is fastest, are always in
    one. Frames left over at the beginning only initialise the model state.
    """

    states: Array  # (F, n), of all experiments, concatenated
    inputs: Array  # (F, m)
    firsts: Indices  # (r,) frame where the windows of each experiment begin
    leads: Indices  # (r,) frames of each experiment before it
    frames: Indices  # (r,) frames of each experiment after it: whole windows
    window: int
    chunk: int
    noise: Array | float = 0.0  # (n,) standard deviations of measurement noise, as far as known
    smoothed: Array | None = None  # (F, n) states at which predictions begin; default: the recorded ones
    recordings: Indices | None = None  # (r,) recording of each experiment; by default each is its own

    @staticmethod
    def of(rollouts: Sequence[Rollout], window: int, chunk: int, noise: Array | float = 0.0) -> Windows:
        """Windows of a whole number of chunks; frames before a rollout lead to its first window."""
        window = max(1, round(window / chunk)) * chunk
        states, sent, earlier = zip(*(rollout.with_history() for rollout in rollouts), strict=True)
        inputs = [np.pad(each, ((0, 1), (0, 0))) for each in sent]
        k = np.array([rollout.frames for rollout in rollouts], np.int64)
        before = np.array(earlier, np.int64)
        begins = np.cumsum([0, *(before + k + 1)])[:-1]
        leads = before + k % window
        return Windows(
            np.concatenate(states),
            np.concatenate(inputs),
            firsts=begins + leads,
            leads=leads,
            frames=k - k % window,
            window=window,
            chunk=chunk,
            noise=noise,
        )

    def __len__(self) -> int:
        return int(self.frames.sum()) // self.window

    @property
    def begin(self) -> Array:
        """States (F, n) at which predictions may begin."""
        return self.states if self.smoothed is None else self.smoothed

    @property
    def experiments(self) -> Indices:
        """The index (w,) of each window's experiment."""
        return np.repeat(np.arange(len(self.frames)), self.frames // self.window)

    @property
    def starts(self) -> Indices:
        """The row (w,) at which each window begins."""
        each = zip(self.firsts, self.frames, strict=True)
        return np.concatenate([first + np.arange(0, k, self.window) for first, k in each])

    @cached_property
    def moving(self) -> Flags:
        """Whether (w,) a state changes within a window; if in none, all windows count as moving."""
        rows = self.starts[:, None] + np.arange(self.window + 1)
        changes = np.ptp(self.states[rows], axis=1) > REST * np.std(self.states, axis=0)
        moving = changes.any(axis=1)
        return moving | ~moving.any()

    @property
    def apart(self) -> Windows:
        """The same windows, each as a separate experiment without earlier frames."""
        w, starts = len(self), self.starts
        leads, frames = np.zeros(w, np.int64), np.full(w, self.window)
        return replace(self, firsts=starts, leads=leads, frames=frames, recordings=None)

    @property
    def rows(self) -> list[slice]:
        """The rows of each experiment except its last one, after which nothing is predicted."""
        bounds = zip(self.firsts, self.leads, self.frames, strict=True)
        return [slice(first - lead, first + frames) for first, lead, frames in bounds]

    def acted(self, nominal: Nominal) -> Array:
        """Inputs (F, m) that a bias of the model depends on (`Nominal.acted`)."""
        acted = self.inputs.copy()
        for rows in self.rows:
            acted[rows] = nominal.acted_along(self.states[rows], self.inputs[rows])
        return acted

    @property
    def means(self) -> Array:
        """Means (w, J, n) of the recorded states over each chunk, the first from x_1 to x_chunk."""
        rows = self.starts[:, None] + np.arange(1, self.window + 1)
        return self._chunked(self.states[rows])

    def _chunked(self, states: Array) -> Array:
        """Means (w, J, n) of states (w, window, n)."""
        chunks = self.window // self.chunk
        return states.reshape(len(states), chunks, self.chunk, states.shape[2]).mean(axis=2)


@dataclass(frozen=True, eq=False)
class PredictionModel:
    """A model for the prediction of experiments."""

    nominal: Nominal
    offset: Array | None = None  # (n,) added to the state at the beginning of each window


def predict(models: Sequence[PredictionModel], windows: Windows, bias: FittedBias | None = None) -> Array:
    """Means (k, w, J, n) over each chunk, predicted by k models that share the bias."""
    if not len(windows):
        return np.zeros((len(models), *windows.means.shape))
    n, points = windows.states.shape[1], partial(points_among, windows.states, windows.inputs)
    kernels = [of_nominal(model.nominal, points).kernel for model in models]
    correct = constant(np.zeros(n)) if bias is None else of_bias(bias, points).kernel
    alike = all(each is not None and each.function is kernels[0].function for each in kernels)
    if correct is None or not alike or _remembers_states(models[0].nominal, windows):
        return plain(models, windows, bias)
    steps = Kernel(kernels[0].function, np.array([kernel.parameters for kernel in kernels]))
    offsets = np.array([np.zeros(n) if model.offset is None else model.offset for model in models])
    return _compiled(windows, steps, correct, offsets, models[0].nominal)


def _remembers_states(nominal: Nominal, windows: Windows) -> bool:
    """Whether a model state depends on states; a compiled loop would use predicted, not recorded ones."""
    if not nominal.state_size:
        return False
    x, u = windows.states[:SOME], windows.inputs[:SOME]
    return not np.array_equal(nominal.model_states(x, u), nominal.model_states(x + 1.0, u))


def _compiled(
    windows: Windows, step: Kernel, correct: Kernel, offsets: Array, nominal: Nominal | None = None
) -> Array:
    """Means (k, w, J, n) of k models, by kernels in lanes and threads."""
    n, m = windows.states.shape[1], windows.inputs.shape[1]
    model_state = (nominal.state_size, nominal.acting) if nominal else (0, ())
    if not model_state[0]:
        windows = windows.apart  # to use all lanes and threads
    chunks = windows.frames // windows.chunk
    means = np.empty((len(offsets), chunks.sum(), n))
    loop = partial(
        compile_open_loop(Function.of(step), Function.of(correct), n, m, *model_state),
        *(windows.window, windows.chunk, step.parameters, correct.parameters, offsets),
        *(windows.firsts, windows.leads, windows.frames, np.cumsum(chunks) - chunks),
        *map(np.ascontiguousarray, (windows.begin, windows.inputs)),  # otherwise another loop is compiled
        means,
    )
    in_threads(loop, len(offsets) * len(windows.firsts))
    return means.reshape(len(offsets), len(windows), windows.window // windows.chunk, n)


def corrections(bias: FittedBias, x: Array, u: Array) -> Array:
    """Corrections (k, n) of a bias at x (k, n), u (k, m); compiled if it has a kernel with linear algebra.

    When compiled, they are predictions of k one-frame experiments by a model with zero steps.
    """
    if bias.kernel is None or not Function.of(bias.kernel).takes_all_lanes:
        return bias.correction(x, u)
    k, n = x.shape
    once, rows = np.ones(k, np.int64), np.arange(k)
    windows = Windows(x, u, rows, 0 * once, once, window=1, chunk=1)
    step = constant(np.zeros((1, n)))
    return _compiled(windows, step, bias.kernel, np.zeros((1, n)))[0, :, 0]


def plain(models: Sequence[PredictionModel], windows: Windows, bias: FittedBias | None = None) -> Array:
    """Predictions in NumPy, for any components: the reference of the compiled `predict`."""
    return np.array([_plain(model, windows, bias) for model in models])


def _plain(model: PredictionModel, windows: Windows, bias: FittedBias | None) -> Array:
    """Predictions of one model, all windows in lockstep."""
    nominal, starts = model.nominal, windows.starts
    x = windows.begin[starts] + (0.0 if model.offset is None else model.offset)
    model_state, made = model_states(nominal, windows), np.empty((len(starts), windows.window, x.shape[1]))
    for t in range(windows.window):
        u = windows.inputs[starts + t]
        x_next, model_state = nominal.advance(x, u, model_state)
        if bias is not None:
            x_next = x_next + bias.correction(x, nominal.acted(u, model_state))
        made[:, t] = x = x_next
    return windows._chunked(made)


def model_states(nominal: Nominal, windows: Windows) -> Array:
    """The model state (w, s) at the beginning of each window, from the earlier inputs."""
    kept = np.zeros((len(windows.states), nominal.state_size))
    if nominal.state_size:
        for rows in windows.rows:
            kept[rows] = nominal.model_states(windows.states[rows], windows.inputs[rows])
    return kept[windows.starts]
