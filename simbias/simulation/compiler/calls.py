"""Calls of kernels in a trace: a policy may predict with a model that has no formula, such as MuJoCo's."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import chain
from typing import Any

import numpy as np

from simbias.core import Kernel
from simbias.core.records import Array
from simbias.simulation.compiler.compilation import compiled_as
from simbias.simulation.compiler.symbolic_arrays import array, symbols_in, trace_of


def is_traced(*vectors: Array) -> bool:
    """Whether one of these vectors holds symbols."""
    return any(vector.dtype == object for vector in vectors)


def traced_call(owner: Any, kernel: Kernel, size: int, *vectors: Array) -> Array:
    """A kernel's results (..., size) for vectors (..., .) of symbols and numbers; its owner is kept."""
    trace, shape = trace_of(vectors), np.broadcast_shapes(*(vector.shape[:-1] for vector in vectors))
    assert trace is not None
    trace.kept.append(owner)
    columns = [
        np.broadcast_to(symbols_in(each, trace), (*shape, each.shape[-1])).reshape(-1, each.shape[-1])
        for each in vectors
    ]
    function, parameters = _of_columns(kernel.function), list(map(trace.number, kernel.parameters.tolist()))
    made = [trace.call(function, *row, parameters, size=size) for row in zip(*columns, strict=True)]
    return array(made).reshape(*shape, size)


@cache
def _of_columns(function: Callable) -> Callable:
    """A function of numbers that also takes columns of them in Python; compiled code calls it as it is."""

    @compiled_as(function)
    def of_columns(*vectors: tuple[Any, ...]) -> tuple[Array, ...]:
        sizes = np.cumsum([len(vector) for vector in vectors])[:-1]
        given = np.stack(np.broadcast_arrays(*chain.from_iterable(vectors)), axis=-1)
        rows = given.reshape(-1, given.shape[-1]).tolist()
        made = np.array([function(*map(tuple, np.split(row, sizes))) for row in rows])
        return tuple(np.moveaxis(made.reshape(*given.shape[:-1], -1), -1, 0))

    return of_columns
