"""Symbolic numbers that record the operations on them.

A component's method is called once on such numbers (`simbias.simulation.compiler.symbolic_arrays` are NumPy's
arrays of them); its computation is then a list of operations on single numbers, from which
`simbias.simulation.compiler.tracing` makes a kernel. Code that needs a value, because it branches on it or
passes it to something other than NumPy, gets a `TraceError`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

MOST = 3000  # operations and numbers: LLVM takes a minute to compile 2,500 of them, some seconds for 300
LOOKED_UP = "looked_up"  # the operation of a table: see `simbias.simulation.compiler.tables`


class TraceError(TypeError):
    """An operation on a symbol cannot be written down; the message names it."""


class Trace:
    """The recorded operations, each only once.

    Numbers in the code become parameters of the kernel; integers, as in `x / 2` and `1 + x`, are written
    literally. No operation is omitted because of a number's value, and equal numbers stay separate
    parameters: models that differ only in numbers have the same operations.
    """

    def __init__(self) -> None:
        self.symbols: list[Symbol] = []
        self.functions: dict[str, Callable] = {}  # that are called, by their names in the text
        self.kept: list[Any] = []  # objects whose addresses are among their parameters
        self._known: dict[tuple, Symbol] = {}
        self._counted = 0  # number of symbols, except arguments and table entries, which need no compilation

    def given(self, name: str) -> Symbol:
        """A number that is an argument of the written function, by its name there."""
        return self._add("given", value=name, counts=False)

    def number(self, value: Any, whole: bool = False) -> Symbol:
        """A known number; if it is `whole`, or computed from such numbers, it is written literally."""
        if isinstance(value, complex | np.complexfloating):
            raise TraceError("it computes with complex numbers")
        if isinstance(value, bool | np.bool_):
            return self.operation("is_true", self.number(float(value), whole), truth=True)
        if not whole and not isinstance(value, int | np.integer):
            return self._add("number", value=float(value))
        key = ("whole", float(value))
        if key not in self._known:
            self._known[key] = self._add("number", value=float(value), whole=True)
        return self._known[key]

    def entry(self, value: float) -> Symbol:
        """A number of a table."""
        return self._add("number", value=float(value), counts=False)

    def operation(self, name: str, *operands: Symbol, truth: bool = False, text: str | None = None) -> Symbol:
        """An operation's result; the same one gives the same symbol. `text` is how a call is written."""
        key = (name, *(operand.index for operand in operands))
        if key not in self._known:
            self._known[key] = self._add(name, operands, value=text, truth=truth)
        return self._known[key]

    def call(self, function: Callable, *vectors: Sequence[Symbol], size: int) -> list[Symbol]:
        """The numbers (size,) that a function of vectors gives."""
        names = {known: name for name, known in self.functions.items()}
        name = names.get(function, f"called{len(names)}")
        self.functions[name] = function
        given = ", ".join(f"({'{}, ' * len(each)})" for each in vectors)
        made = self.operation(name, *chain.from_iterable(vectors), text=f"{name}({given})")
        return [self.operation(f"result {i}", made, text=f"{{}}[{i}]") for i in range(size)]

    def _add(
        self,
        name: str,
        operands: tuple[Symbol, ...] = (),
        value: Any = None,
        truth: bool = False,
        whole: bool = False,
        counts: bool = True,
    ) -> Symbol:
        """Add a symbol."""
        self._counted += counts
        if self._counted > MOST:
            raise TraceError(f"it takes more than {MOST} operations, on single numbers")
        symbol = Symbol(self, name, operands, value, truth, whole)
        self.symbols.append(symbol)
        return symbol


class Symbol(NDArrayOperatorsMixin):
    """A number that is not known yet, or a condition."""

    __slots__ = ("index", "name", "operands", "quotient_of", "trace", "truth", "value", "whole")

    def __init__(
        self, trace: Trace, name: str, operands: tuple[Symbol, ...], value: Any, truth: bool, whole: bool
    ) -> None:
        self.trace = trace
        self.index = len(trace.symbols)  # in the trace, after its operands
        self.name = name  # of the operation
        self.operands = operands
        self.value = value  # of a number; for an argument, its name; for a call, its text
        self.truth = truth  # whether it is a condition
        self.whole = whole  # whether it is a number that is written literally
        self.quotient_of: tuple[Symbol, Symbol] | None = None  # the quotient that this product replaces

    def __hash__(self) -> int:
        return id(self)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        return arrays().applied(ufunc, method, inputs, options)

    def __array_function__(self, function: Callable, types: Any, arguments: Any, options: Any) -> Any:
        return arrays().called(function, arguments, options)

    def __getitem__(self, index: Any) -> Any:
        return arrays().array(self)[index]

    def __getattr__(self, name: str) -> Any:
        """An attribute that NumPy's numbers also have; NumPy looks up functions of elements by name."""
        if name.startswith("__"):
            raise AttributeError(name)
        from simbias.simulation.compiler.rules import BY_NAME  # it imports this module

        rule = BY_NAME.get(name)
        return partial(rule, self) if rule else getattr(arrays().array(self), name)


def arrays() -> Any:
    """The module of symbol arrays, which imports this one."""
    from simbias.simulation.compiler import symbolic_arrays

    return symbolic_arrays


def refusal(what: str) -> Callable:
    """A method that raises."""

    def refuse(*_: Any) -> Any:
        raise TraceError(what)

    return refuse


Symbol.__bool__ = refusal("it branches on a value; use np.where")  # type: ignore[attr-defined]
_NEEDS = (
    "it needs a number, as float(), math, np.asarray(x, float) and arrays of np.zeros do; "
    "use x.astype(float) and np.zeros_like"
)
for _name in ("float", "int", "index", "complex", "round", "trunc", "floor", "ceil"):
    setattr(Symbol, f"__{_name}__", refusal(_NEEDS))


def numeric(symbol: Symbol) -> Symbol:
    """A symbol as a number: 1 where a condition holds, else 0."""
    return symbol.trace.operation("indicator", symbol) if symbol.truth else symbol
