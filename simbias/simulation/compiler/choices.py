"""Choices between two numbers: without branches in compiled code, elementwise in NumPy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from simbias.simulation.compiler.compilation import compiled_as


def _choice(of_arrays: Callable) -> Callable[[Callable], Callable]:
    """Decorate a function of numbers so that, uncompiled, it is NumPy's function of arrays."""

    def choice(of_numbers: Callable) -> Callable:
        return compiled_as(of_numbers)(lambda *values: of_arrays(*values))

    return choice


@_choice(np.minimum)
def lesser(a, b):
    """The lesser of two; nan if one of them is."""
    return a if a < b or a != a else b


@_choice(np.maximum)
def greater(a, b):
    """The greater of two; nan if one of them is."""
    return a if a > b or a != a else b


@_choice(np.minimum)
def at_most(a, limit):
    """The lesser of a number and a limit; nan if the first is."""
    return min(a, limit)


@_choice(np.maximum)
def at_least(a, limit):
    """The greater of a number and a limit; nan if the first is."""
    return max(a, limit)


@_choice(np.where)
def chosen(condition, a, b):
    """The first of two where a condition holds, else the second."""
    return a if condition else b
