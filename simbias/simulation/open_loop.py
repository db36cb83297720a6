"""Predictions of recorded experiments under their recorded inputs, many models in step.

Every experiment is one long pass. At the beginning of each window the state is reset to the recorded one;
what the state does not show, the memory of the nominal model, runs on. What comes out are means over chunks
of successive frames: they hold what single noisy frames say, in fewer numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from simbias.core import FittedBias, Kernel, Nominal
from simbias.core.records import Array, Indices, Rollout
from simbias.simulation.compiler.compilation import OPTIONS, Compilation
from simbias.simulation.compiler.correction import for_all_lanes
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.open_loop_template import TEMPLATE
from simbias.simulation.compiler.points import Points
from simbias.simulation.compiler.text import assign, indent, tuple_of
from simbias.simulation.compiler.threads import in_threads
from simbias.simulation.compiler.tracing import of_bias, of_nominal


@dataclass(frozen=True, eq=False)
class Windows:
    """Recorded experiments, cut into w windows of `window` frames, and these into J chunks of `chunk` frames.

    Windows are counted from the end, where those who fall are the fastest. What is left over at the beginning
    is no window: it only fills the memory of models that have one.
    """

    states: Array  # (F, n), of all experiments
    inputs: Array  # (F, m)
    firsts: Indices  # (r,) frame in which the windows of each experiment begin
    leads: Indices  # (r,) frames of each experiment before that
    frames: Indices  # (r,) and after that: whole windows
    window: int
    chunk: int

    @staticmethod
    def of(rollouts: Sequence[Rollout], window: int, chunk: int) -> Windows:
        """Windows of a whole number of chunks."""
        window = max(1, round(window / chunk)) * chunk
        states = [rollout.states for rollout in rollouts]
        inputs = [np.concatenate([r.inputs, np.zeros((1, r.inputs.shape[1]))]) for r in rollouts]
        k = np.array([rollout.frames for rollout in rollouts], np.int64)
        begins = np.cumsum([0, *(k + 1)])[:-1]
        leads = k % window
        return Windows(
            np.concatenate(states),
            np.concatenate(inputs),
            firsts=begins + leads,
            leads=leads,
            frames=k - leads,
            window=window,
            chunk=chunk,
        )

    def __len__(self) -> int:
        return int(self.frames.sum()) // self.window

    @property
    def experiments(self) -> Indices:
        """Of each window (w,): its experiment."""
        return np.repeat(np.arange(len(self.frames)), self.frames // self.window)

    @property
    def starts(self) -> Indices:
        """Of each window (w,): the row in which it begins."""
        each = [
            first + np.arange(0, k, self.window) for first, k in zip(self.firsts, self.frames, strict=True)
        ]
        return np.concatenate(each)

    @property
    def means(self) -> Array:
        """Means (w, J, n) of the recorded states over each chunk: the first one's are x_1 to x_chunk."""
        rows = self.starts[:, None] + np.arange(1, self.window + 1)
        return self._chunked(self.states[rows])

    def _chunked(self, states: Array) -> Array:
        """Means (w, J, n) of states (w, window, n)."""
        chunks = self.window // self.chunk
        return states.reshape(len(states), chunks, self.chunk, states.shape[2]).mean(axis=2)


@dataclass(frozen=True, eq=False)
class World:
    """A model that experiments are predicted with."""

    nominal: Nominal
    weight: float = 1.0  # of the bias
    offset: Array | None = None  # (n,) added to the state at the beginning of each window


def predict(worlds: Sequence[World], windows: Windows, bias: FittedBias | None = None) -> Array:
    """Means (k, w, J, n) over each chunk as each of k worlds predicts it; they share the bias."""
    if not len(windows):
        return np.zeros((len(worlds), *windows.means.shape))
    points = Points.among(windows.states, windows.inputs)
    kernels = [of_nominal(world.nominal, points).kernel for world in worlds]
    correct = None if bias is None else of_bias(bias, points).kernel
    if any(kernel is None or kernel.function is not kernels[0].function for kernel in kernels):
        return plain(worlds, windows, bias)
    if bias is not None and correct is None:
        return plain(worlds, windows, bias)
    return _compiled(worlds, windows, kernels, correct)


def _compiled(
    worlds: Sequence[World], windows: Windows, kernels: Sequence[Kernel], correct: Kernel | None
) -> Array:
    """Without Python, in lanes and threads."""
    n, m, hidden = windows.states.shape[1], windows.inputs.shape[1], worlds[0].nominal.memory_size
    parameters = np.array([kernel.parameters for kernel in kernels])
    step = kernels[0].function
    loop = compiled_open_loop(Composition.of(step, correct, n, m, hidden, parameters.shape[1]))
    chunks = windows.frames // windows.chunk
    means = np.empty((len(worlds), chunks.sum(), n))
    offsets = np.array([np.zeros(n) if world.offset is None else world.offset for world in worlds])
    weights = np.array([world.weight for world in worlds])
    first_chunks = np.cumsum([0, *chunks])[:-1]
    given = correct.parameters if correct else np.empty(0)

    def run(begin: int, end: int) -> None:
        loop(
            windows.window, windows.chunk, parameters, given, weights, offsets,
            windows.firsts, windows.leads, windows.frames, first_chunks, windows.states, windows.inputs,
            begin, end, means,
        )  # fmt: skip

    in_threads(run, len(worlds) * len(windows.firsts))
    return means.reshape(len(worlds), len(windows), windows.window // windows.chunk, n)


def plain(worlds: Sequence[World], windows: Windows, bias: FittedBias | None = None) -> Array:
    """The same in NumPy: for any components; the compiled loop's reference."""
    return np.array([_plain(world, windows, bias) for world in worlds])


def _plain(world: World, windows: Windows, bias: FittedBias | None) -> Array:
    """Of one world, all windows side by side."""
    nominal, starts = world.nominal, windows.starts
    x = windows.states[starts] + (0.0 if world.offset is None else world.offset)
    memory, made = memories(nominal, windows), np.empty((len(starts), windows.window, x.shape[1]))
    for t in range(windows.window):
        u = windows.inputs[starts + t]
        x_next, memory = nominal.advance(x, u, memory)
        made[:, t] = x = x_next if bias is None else x_next + world.weight * bias.correction(x, u)
    return windows._chunked(made)


def memories(nominal: Nominal, windows: Windows) -> Array:
    """The memory (w, s) of the model at the beginning of each window: what the inputs before leave in it."""
    kept = np.zeros((len(windows.states), nominal.memory_size))
    if nominal.memory_size:
        for first, lead, frames in zip(windows.firsts, windows.leads, windows.frames, strict=True):
            rows = slice(first - lead, first + frames)
            kept[rows] = nominal.memories(windows.states[rows], windows.inputs[rows])
    return kept[windows.starts]


@dataclass(frozen=True)
class Composition:
    """Kernels of an open loop, and the sizes of what they take."""

    step: Callable
    correct: Callable | None
    states: int  # n
    inputs: int  # m
    hidden: int  # s of the nominal model
    nominal_parameters: int
    bias_parameters: int

    @staticmethod
    def of(step: Callable, bias: Kernel | None, n: int, m: int, hidden: int, nominal: int) -> Composition:
        """Of a nominal model's kernel and a bias'."""
        if bias is None:
            return Composition(step, None, n, m, hidden, nominal, 0)
        size = 0 if isinstance(bias.parameters, tuple) else len(bias.parameters)
        return Composition(step, bias.function, n, m, hidden, nominal, size)

    @property
    def corrects_all_lanes(self) -> bool:
        """Whether the bias is a kernel for all lanes."""
        return self.correct is not None and for_all_lanes(self.correct)


def source(c: Composition) -> str:
    """The text of a composition's loop."""
    n, m = c.states, c.inputs
    sizes = {"x": n, "u": m, "correction": n, "total": n, "nominal": c.nominal_parameters, "weight": 1}
    sizes |= {"hidden": c.hidden}
    ends = np.cumsum(list(sizes.values())).tolist()
    rows = [f"lanes = zeros(({ends[-1]}, {LANES}))"]
    rows += [
        f"{name} = lanes[{end - size}:{end}]" for (name, size), end in zip(sizes.items(), ends, strict=True)
    ]
    parameters = tuple_of("nominal[{}, lane]", c.nominal_parameters)
    advance = [f"y = step(x_, u_, {parameters})"]
    if c.hidden:
        advance = [
            f"y, kept = step(x_, u_, {parameters}, {tuple_of('hidden[{}, lane]', c.hidden)})",
            *assign("hidden", "kept", c.hidden),
        ]
    constants: list[str] = []
    x_new = "y[{0}]"
    if c.corrects_all_lanes:
        x_new = "y[{0}] + weight[0, lane] * correction[{0}, lane]"
    elif c.correct:
        constants = [f"bias_data = {tuple_of('bias_parameters[{}]', c.bias_parameters)}"]
        advance.append("d = correct(x_, u_, bias_data)")
        x_new = "y[{0}] + weight[0, lane] * d[{0}]"
    settle = [f"x_new = {tuple_of(x_new, n)}", *assign("x", "x_new", n)]
    settle += [f"total[{i}, lane] += x_new[{i}]" for i in range(n)]
    return TEMPLATE.format(
        n=n,
        m=m,
        LANES=LANES,
        nominal=c.nominal_parameters,
        hidden=c.hidden,
        rows=indent(rows, 4),
        constants=indent(constants, 4),
        correct_all="correct(x, u, bias_parameters, correction)" if c.corrects_all_lanes else "",
        x=tuple_of("x[{}, lane]", n),
        u=tuple_of("u[{}, lane]", m),
        advance=indent(advance, 12),
        settle=indent(settle, 12),
    )


@lru_cache(maxsize=64)
def compiled_open_loop(c: Composition) -> Any:
    """The composition's loop, ready to be called."""
    compilation = Compilation()
    names = {"step": compilation.compiled(c.step)}
    if c.correct:
        names["correct"] = compilation.compiled(c.correct, inline=not c.corrects_all_lanes)
    module: Any = compilation.module(source(c), **names, zeros=np.zeros, int64=np.int64, nan=np.nan)
    if not hasattr(module, "compiled"):
        module.compiled = njit(**OPTIONS, cache=True)(module.open_loop)
    return module.compiled
