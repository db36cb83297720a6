"""The text of a kernel, from the operations of a trace."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from simbias.core.records import Array
from simbias.simulation.compiler.choices import at_least, at_most, chosen, greater, lesser
from simbias.simulation.compiler.compilation import function_of
from simbias.simulation.compiler.symbols import OF_NUMPY, Symbol, Trace
from simbias.simulation.compiler.trigonometry import arctan, sincos

NAMES = {
    "np": np,
    "sincos": sincos,
    "arctan": arctan,
    "lesser": lesser,
    "greater": greater,
    "at_most": at_most,
    "at_least": at_least,
    "chosen": chosen,
}

# What is written of each operation, for numbers and for NumPy's arrays; sine and cosine are written together.
TEXTS: Mapping[str, str] = {
    **{name: f"np.{name}({{}})" for name in OF_NUMPY},
    "arctan2": "np.arctan2({}, {})",
    "copysign": "np.copysign({}, {})",
    "sqrt": "np.sqrt({})",
    "floor": "np.floor({})",
    "add": "{} + {}",
    "subtract": "{} - {}",
    "multiply": "{} * {}",
    "divide": "{} / {}",
    "inverse": "1.0 / {}",
    "negative": "-{}",
    "power": "{} ** {}",
    "abs": "abs({})",
    "sign": "chosen({0} > 0.0, 1.0, chosen({0} < 0.0, -1.0, {0}))",
    "arctan": "arctan({})",
    "minimum": "lesser({}, {})",
    "maximum": "greater({}, {})",
    "at_most": "at_most({}, {})",
    "at_least": "at_least({}, {})",
    "chosen": "chosen({}, {}, {})",
    "indicator": "chosen({}, 1.0, 0.0)",
    "is_true": "{} != 0.0",
    "finite": "{0} - {0} == 0.0",
    "less": "{} < {}",
    "less_equal": "{} <= {}",
    "equal": "{} == {}",
    "not_equal": "{} != {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "not": "{} == False",
}


class Written(NamedTuple):
    """A kernel's function, and the numbers in it."""

    function: Callable
    numbers: Array  # (c,), the last of its parameters


def written(
    trace: Trace,
    results: Sequence[Sequence[Symbol]],
    arguments: str,
    before: Sequence[Symbol] = (),
    numbers_name: str = "p",
) -> Written:
    """The function that gives these vectors; p is what is computed before, and the numbers have a name too.

    Of the same operations it is the same function.
    """
    names = {symbol.index: f"p[{index}]" for index, symbol in enumerate(before)}
    lines: list[str] = []
    numbers: list[float] = []
    pairs: dict[int, str] = {}  # sine and cosine of an angle
    for symbol in needed(trace, results, set(names)):
        operands = [names[operand.index] for operand in symbol.operands]
        if symbol.name == "given":
            names[symbol.index] = symbol.value
            continue
        if symbol.name == "number":
            names[symbol.index] = f"{numbers_name}[{len(numbers)}]"
            numbers.append(symbol.value)
            continue
        if symbol.name in ("sin", "cos"):
            angle = symbol.operands[0].index
            if angle not in pairs:
                pairs[angle] = f"v{len(lines)}"
                lines.append(f"{pairs[angle]} = sincos({operands[0]})")
            names[symbol.index] = f"{pairs[angle]}[{0 if symbol.name == 'sin' else 1}]"
            continue
        names[symbol.index] = f"v{len(lines)}"
        lines.append(f"v{len(lines)} = {TEXTS[symbol.name].format(*operands)}")
    vectors = ["(" + "".join(f"{names[symbol.index]}, " for symbol in vector) + ")" for vector in results]
    lines.append(f"return {', '.join(vectors)}")
    text = f"def traced({arguments}):\n    " + "\n    ".join(lines) + "\n"
    return Written(function_of(text, "traced", **NAMES), np.array(numbers, dtype=np.float64))


def needed(trace: Trace, results: Sequence[Sequence[Symbol]], known: Collection[int] = ()) -> list[Symbol]:
    """What is needed for these vectors, besides what is known, in the order in which it was asked for."""
    wanted = {symbol.index for vector in results for symbol in vector} - set(known)
    for symbol in reversed(trace.symbols):
        if symbol.index in wanted:
            wanted |= {operand.index for operand in symbol.operands} - set(known)
    return [symbol for symbol in trace.symbols if symbol.index in wanted]


def columns(function: Callable, *arguments: Any) -> tuple[Any, ...]:
    """What the function gives (..., r) for rows of vectors (k, n), numbers of each row (k,) and others."""
    given = [tuple(each.T) if isinstance(each, np.ndarray) and each.ndim > 1 else each for each in arguments]
    with np.errstate(all="ignore"):
        return function(*given)
