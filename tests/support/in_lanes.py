"""Compiled functions, called on their own."""

from collections.abc import Callable
from functools import cache
from inspect import signature
from typing import Any

import numpy as np
from numba import njit

from simbias.core import FittedBias
from simbias.core.records import Array
from simbias.simulation.compiler import LANES
from simbias.simulation.compiler.compilation import OPTIONS, Compilation


@cache
def from_python(function: Callable, inline: bool = True) -> Any:
    """A function, compiled as a part of compiled code, that Python can call all the same; kept on disk."""
    compilation = Compilation()
    part = compilation.compiled(function, inline)
    arguments = ", ".join(f"a{index}" for index in range(len(signature(function).parameters)))
    module = compilation.module(f"def call({arguments}):\n    return part({arguments})\n", part=part)
    return njit(**OPTIONS, cache=True)(module.call)


def corrections(fitted: FittedBias, inputs: Array, n: int = 6) -> Array:
    """What it adds (k, n) at raw inputs (k, n+m), up to LANES of them at a time."""
    correct = from_python(fitted.kernel.function, inline=False)
    values = []
    for first in range(0, len(inputs), LANES):
        some = inputs[first : first + LANES]
        rows = np.pad(some, ((0, LANES - len(some)), (0, 0))).T
        x, u = (_before_nothing(part) for part in np.split(rows, [n]))
        correction = np.empty((n, LANES))
        correct(x, u, fitted.kernel.parameters, correction)
        values.append(correction.T[: len(some)])
    return np.concatenate(values)


def _before_nothing(rows: Array) -> Array:
    """The same, with no numbers behind: what reads beyond the last row gets them."""
    return np.ascontiguousarray(np.concatenate([rows, np.full((1, LANES), np.nan)]))[: len(rows)]
