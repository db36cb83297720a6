"""Kernels as formulas: they are called with symbols in place of numbers.

A kernel has no branches (`simbias.simulation.compiler.kernels`), so one call with symbols says all that it
does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import CellType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from simbias.simulation.compiler import sincos


class UntraceableError(ValueError):
    """A function does what no formula says."""


def vector(name: str, size: int) -> tuple[Any, ...]:
    """Symbols `name[0]` to `name[size - 1]`."""
    import sympy  # lazily: it takes half a second

    return tuple(sympy.Symbol(f"{name}[{index}]", real=True) for index in range(size))


def scalar(name: str) -> Any:
    """A symbol."""
    import sympy

    return sympy.Symbol(name, real=True)


def formulas(kernel: Callable, *arguments: Any) -> Any:
    """What a kernel returns for symbols.

    Raises
    ------
    UntraceableError
        If it asks a symbol for its value, as a branch does, or calls what knows no symbols.
    """
    try:
        return _linked(kernel, {})(*arguments)
    except Exception as error:
        raise UntraceableError(f"{getattr(kernel, '__name__', kernel)} is no formula ({error})") from error


def _linked(function: Any, known: dict[int, Any]) -> Any:
    """A copy of a function that calls functions of symbols."""
    function = getattr(function, "py_func", function)
    if id(function) not in known:
        links = {name: _link(value, known) for name, value in function.__globals__.items()}
        cells = tuple(CellType(_link(cell.cell_contents, known)) for cell in function.__closure__ or ())
        known[id(function)] = FunctionType(
            function.__code__, {**links, **_builtins()}, function.__name__, function.__defaults__, cells
        )
    return known[id(function)]


def _link(value: Any, known: dict[int, Any]) -> Any:
    """What a global name stands for among symbols."""
    import sympy

    if value is sincos:
        return lambda x: (sympy.sin(x), sympy.cos(x))
    if isinstance(value, ModuleType) and value in (np, math):
        return _mathematics(value)
    if isinstance(value, FunctionType) or hasattr(value, "py_func"):
        return lambda *arguments: _linked(value, known)(*arguments)  # when it is called: most never are
    return value


def _builtins() -> dict[str, Any]:
    """Python's own functions that a kernel may call."""
    import sympy

    return {"min": sympy.Min, "max": sympy.Max, "abs": sympy.Abs}


def _mathematics(module: ModuleType) -> SimpleNamespace:
    """NumPy or math, its functions those of symbols."""
    import sympy

    same = ("sqrt", "sin", "cos", "tan", "exp", "log", "floor", "sign", "tanh", "sinh", "cosh")
    functions = {name: getattr(sympy, name) for name in same}
    others = {"arctan2": sympy.atan2, "atan2": sympy.atan2, "abs": sympy.Abs, "fabs": sympy.Abs}
    extremes = {"minimum": sympy.Min, "maximum": sympy.Max}
    return SimpleNamespace(**{**vars(module), **functions, **others, **extremes})


def shared(expressions: Sequence[Any], prefix: str) -> tuple[list[tuple[str, Any]], list[Any]]:
    """Expressions in terms of what they share: named intermediate results, and the rest."""
    import sympy

    names = sympy.numbered_symbols(prefix, real=True)
    steps, rest = sympy.cse([sympy.sympify(each) for each in expressions], names, order="none")
    return [(str(name), value) for name, value in steps], rest
