"""The text of a trace's operations: in Python, for Numba and NumPy, and in C."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from simbias.core import Kernel
from simbias.simulation.compiler.choices import at_least, at_most, chosen, greater, lesser
from simbias.simulation.compiler.compilation import function_of
from simbias.simulation.compiler.rules import OF_NUMPY, ROUNDED
from simbias.simulation.compiler.symbols import LOOKED_UP, Symbol, Trace, TraceError
from simbias.simulation.compiler.trigonometry import arctan, sincos, tanh

NAMES = {"np": np, "lesser": lesser, "greater": greater, "chosen": chosen}
NAMES |= {"at_most": at_most, "at_least": at_least, "sincos": sincos, "arctan": arctan, "tanh": tanh}
LONGEST = 1000  # tuple that Numba passes to a function
SHORT = 70  # characters of an expression that is inlined where it is used

_IN_ALL = {
    "add": "{} + {}",
    "subtract": "{} - {}",
    "multiply": "{} * {}",
    "divide": "{} / {}",
    "inverse": "1.0 / {}",
    "negative": "-{}",
    "is_true": "{} != 0.0",
    "less": "{} < {}",
    "less_equal": "{} <= {}",
    "equal": "{} == {}",
    "not_equal": "{} != {}",
}
_OF_TWO = ("arctan2", "copysign", "fmod", "power")
_IN_NUMPY = {
    **_IN_ALL,
    **{name: f"np.{name}({{}})" for name in ("sqrt", "arctan", "sign", *ROUNDED, *OF_NUMPY)},
    **{name: f"np.{name}({{}}, {{}})" for name in (*_OF_TWO, "minimum", "maximum")},
    "angle": "{}",
    "sin": "np.sin({})",
    "cos": "np.cos({})",
    "at_most": "np.minimum({1}, {0})",
    "at_least": "np.maximum({1}, {0})",
    "abs": "abs({})",
    "chosen": "np.float64({1} if {0} else {2})",
    "indicator": "np.float64({})",
    "finite": "np.isfinite({})",
    "and": "{} and {}",
    "or": "{} or {}",
    "not": "not {}",
}
_IN_NUMBA = {  # also for NumPy arrays
    **_IN_NUMPY,
    "angle": "sincos({})",
    "sin": "{}[0]",
    "cos": "{}[1]",
    "arctan": "arctan({})",
    "tanh": "tanh({})",
    "power": "{} ** {}",
    "sign": "chosen({0} > 0.0, 1.0, chosen({0} < 0.0, -1.0, {0}))",
    "minimum": "lesser({}, {})",
    "maximum": "greater({}, {})",
    "at_most": "at_most({}, {})",
    "at_least": "at_least({}, {})",
    "chosen": "chosen({}, {}, {})",
    "indicator": "chosen({}, 1.0, 0.0)",
    "finite": "{0} - {0} == 0.0",
    "and": "{} & {}",
    "or": "{} | {}",
    "not": "{} == False",
}
_C_NAMES = {
    "arcsin": "asin",
    "arccos": "acos",
    "arctan": "atan",
    "arctan2": "atan2",
    "power": "pow",
    "arcsinh": "asinh",
    "arccosh": "acosh",
    "arctanh": "atanh",
    "abs": "fabs",
}
_OF_ONE_IN_C = ("sqrt", "sin", "cos", "arctan", "abs", *ROUNDED)
_IN_C = {
    **_IN_ALL,
    **{name: f"{_C_NAMES.get(name, name)}({{}})" for name in (*_OF_ONE_IN_C, *OF_NUMPY)},
    **{name: f"{_C_NAMES.get(name, name)}({{}}, {{}})" for name in _OF_TWO},
    "angle": "{}",
    "sign": "{0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0}",
    "minimum": "{0} < {1} || {0} != {0} ? {0} : {1}",
    "maximum": "{0} > {1} || {0} != {0} ? {0} : {1}",
    "at_most": "{0} > {1} ? {1} : {0}",
    "at_least": "{0} < {1} ? {1} : {0}",
    "chosen": "{} ? {} : {}",
    "indicator": "{} ? 1.0 : 0.0",
    "finite": "isfinite({})",
    "and": "{} && {}",
    "or": "{} || {}",
    "not": "!{}",
}


@dataclass(frozen=True)
class Language:
    """The notation of operations, numbers and statements in a language."""

    operations: Mapping[str, str]
    infinity: str = "np.inf"
    nan: str = "np.nan"
    statement: str = "{} = {}"
    condition: str = "{} = {}"  # the statement of a condition
    table: str = "{} = ({},)"  # the statement of a column,
    interpolated: str = "np.interp({}, np.arange({}), {})"  # its value at a position between its rows

    def number(self, value: float) -> str:
        """A number, as an operand."""
        if math.isfinite(value):
            return repr(value) if math.copysign(1.0, value) > 0 else f"({value!r})"
        return self.nan if math.isnan(value) else self.infinity if value > 0 else f"(-{self.infinity})"


NUMBA, NUMPY = Language(_IN_NUMBA), Language(_IN_NUMPY)
C = Language(
    _IN_C,
    *("INFINITY", "NAN", "const double {} = {};", "const int {} = {};"),
    *("static const double {}[] = {{{}}};", "simbias_interpolated({}, {}, {})"),
)


def statements(
    trace: Trace, results: Sequence[Sequence[Symbol]], language: Language, names: dict[int, str]
) -> list[str]:
    """Lines that compute these vectors from the named symbols; afterwards the results are named.

    A symbol used once is inlined into the line that uses it, as long as that is short.
    """
    order = needed(trace, results, names)
    uses = Counter(symbol.index for vector in results for symbol in vector)
    for symbol in order:
        text = language.operations.get(symbol.name, "")
        repeated = text == "{}" or text.count("{0}") > 1
        uses.update([operand.index for operand in symbol.operands] * (2 if repeated else 1))
    lines: list[str] = []
    for symbol in order:
        if symbol.name in ("given", "number"):
            names[symbol.index] = symbol.value if symbol.name == "given" else language.number(symbol.value)
            continue
        operands = [names[operand.index] for operand in symbol.operands]
        if symbol.name == LOOKED_UP:
            t, spacing, *entries = operands
            column = f"v{len(lines)}"
            lines.append(language.table.format(column, ", ".join(entries)))
            text = language.interpolated.format(f"{t} / {spacing}", len(entries), column)
        else:
            text = (symbol.value or language.operations[symbol.name]).format(*operands)
        if text == operands[0]:
            names[symbol.index] = text
        elif uses[symbol.index] == 1 and len(text) < SHORT:
            names[symbol.index] = f"({text})"
        else:
            names[symbol.index] = f"v{len(lines)}"
            statement = language.condition if symbol.truth else language.statement
            lines.append(statement.format(names[symbol.index], text))
    return lines


class Formulas(NamedTuple):
    """Symbols of a frame's u (m,) and next policy state (s,), from x (n,), time t and policy state."""

    trace: Trace
    u: list[Symbol]
    policy_state: list[Symbol]

    def written(self, language: Language) -> tuple[list[str], list[str], list[str]]:
        """Lines, and the expressions of u and the next policy state after them."""
        names: dict[int, str] = {}
        lines = statements(self.trace, [self.u, self.policy_state], language, names)
        u, policy_state = (
            [names[symbol.index] for symbol in vector] for vector in (self.u, self.policy_state)
        )
        return lines, u, policy_state

    @property
    def time_dependent(self) -> bool:
        """Whether the formulas depend on the time."""
        return any(symbol.value == "t" for symbol in needed(self.trace, [self.u, self.policy_state]))

    @property
    def looks_up(self) -> bool:
        """Whether the formulas use a lookup table."""
        return any(symbol.name == LOOKED_UP for symbol in needed(self.trace, [self.u, self.policy_state]))


def written(
    trace: Trace,
    results: Sequence[Sequence[Symbol]],
    arguments: str,
    before: Sequence[Symbol] = (),
    numbers_name: str = "p",
    looked_up: Sequence[Symbol] = (),
    compiled: bool = True,
) -> Kernel:
    """The kernel that computes these vectors; p are precomputed parameters, and numbers (c,) are named.

    Looked-up values form a separate row. The same operations give the same function. A TraceError if it is to
    be compiled and needs too many numbers.
    """
    names = {symbol.index: f"p[{index}]" for index, symbol in enumerate(before)}
    names |= {symbol.index: f"row[{index}]" for index, symbol in enumerate(looked_up)}
    order = needed(trace, results, names)
    numbers = [symbol for symbol in order if symbol.name == "number" and not symbol.whole]
    most = max(map(len, (numbers, before, looked_up)))
    if compiled and most > LONGEST:
        raise TraceError(f"it needs {most} constants or parameters, of at most {LONGEST}")
    names |= {symbol.index: f"{numbers_name}[{index}]" for index, symbol in enumerate(numbers)}
    lines = statements(trace, results, NUMBA, names)
    vectors = ["(" + "".join(f"{names[symbol.index]}, " for symbol in vector) + ")" for vector in results]
    lines.append(f"return {', '.join(vectors)}")
    text = f"def traced({arguments}):\n    " + "\n    ".join(lines) + "\n"
    values = np.array([each.value for each in numbers], np.float64)
    return Kernel(function_of(text, "traced", **NAMES, **trace.functions), values)


def needed(trace: Trace, results: Sequence[Sequence[Symbol]], known: Collection[int] = ()) -> list[Symbol]:
    """Symbols that these vectors depend on, except the known ones, in the order of the trace."""
    wanted = {symbol.index for vector in results for symbol in vector} - set(known)
    for symbol in reversed(trace.symbols):
        if symbol.index in wanted:
            wanted |= {operand.index for operand in symbol.operands} - set(known)
    return [symbol for symbol in trace.symbols if symbol.index in wanted]


def columns(function: Callable, *arguments: Any) -> tuple[Any, ...]:
    """The r results of a one-row function, for all rows of vectors (k, n) and numbers (k,) at once."""
    given = [tuple(each.T) if isinstance(each, np.ndarray) and each.ndim > 1 else each for each in arguments]
    with np.errstate(all="ignore"):
        return function(*given)
