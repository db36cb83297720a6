"""Choices between two numbers, which compiled code makes without branches, and NumPy element by element."""

from __future__ import annotations

from typing import Any

import numpy as np

from simbias.simulation.compiler.compilation import compiled_as


def _lesser(a, b):
    """The lesser number; nan if one of them is."""
    return a if a < b or a != a else b


def _greater(a, b):
    """The greater number; nan if one of them is."""
    return a if a > b or a != a else b


def _chosen(condition, a, b):
    """The first number where a condition holds, else the second."""
    return a if condition else b


def _at_most(a, limit):
    """The lesser number; nan if the first is."""
    return min(a, limit)


def _at_least(a, limit):
    """The greater number; nan if the first is."""
    return max(a, limit)


@compiled_as(_at_most)
def at_most(a: Any, limit: Any) -> Any:
    """The lesser of two numbers or, element by element, of arrays; the limit is a number."""
    return np.minimum(a, limit)


@compiled_as(_at_least)
def at_least(a: Any, limit: Any) -> Any:
    """The greater of two numbers or, element by element, of arrays; the limit is a number."""
    return np.maximum(a, limit)


@compiled_as(_lesser)
def lesser(a: Any, b: Any) -> Any:
    """The lesser of two numbers or, element by element, of arrays."""
    return np.minimum(a, b)


@compiled_as(_greater)
def greater(a: Any, b: Any) -> Any:
    """The greater of two numbers or, element by element, of arrays."""
    return np.maximum(a, b)


@compiled_as(_chosen)
def chosen(condition: Any, a: Any, b: Any) -> Any:
    """The first of two numbers where a condition holds, else the second; of arrays, element by element."""
    return np.where(condition, a, b)
