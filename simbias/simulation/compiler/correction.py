"""The correction of a learned bias, compiled, for loops in NumPy: many rows at once, in lanes and threads."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from simbias.core import FittedBias
from simbias.core.records import Array
from simbias.simulation.compiler.compilation import OPTIONS, Compilation
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.threads import in_threads

TEXT = f"""\
def corrections(x, u, data, values):
    n, m = x.shape[1], u.shape[1]
    x_, u_, correction = empty((n, {LANES})), empty((m, {LANES})), empty((n, {LANES}))
    for first in range(0, len(x), {LANES}):
        for lane in range({LANES}):
            row = min(first + lane, len(x) - 1)
            for i in range(n):
                x_[i, lane] = x[row, i]
            for i in range(m):
                u_[i, lane] = u[row, i]
        correct(x_, u_, data, correction)
        for lane in range(min({LANES}, len(x) - first)):
            for i in range(n):
                values[first + lane, i] = correction[i, lane]
"""


def for_all_lanes(correct: Callable) -> bool:
    """Whether the kernel of a bias works on all lanes."""
    return len(inspect.signature(correct).parameters) == len(("x", "u", "data", "correction"))


def corrections(bias: FittedBias, x: Array, u: Array) -> Array:
    """What is added (k, n) at x (k, n), u (k, m): compiled if that takes linear algebra and has a kernel."""
    if bias.kernel is None or not for_all_lanes(bias.kernel.function):
        return bias.correction(x, u)
    loop, data, values = _compiled(bias.kernel.function), bias.kernel.parameters, np.empty(x.shape)
    x, u = np.ascontiguousarray(x), np.ascontiguousarray(u)
    in_threads(lambda begin, end: loop(x[begin:end], u[begin:end], data, values[begin:end]), len(x))
    return values


@lru_cache(maxsize=64)
def _compiled(correct: Callable) -> Any:
    """The loop over rows, ready to be called."""
    compilation = Compilation()
    function = compilation.compiled(correct, inline=False)
    module: Any = compilation.module(TEXT, correct=function, empty=np.empty)
    if not hasattr(module, "compiled"):
        module.compiled = njit(**OPTIONS, cache=True)(module.corrections)
    return module.compiled
