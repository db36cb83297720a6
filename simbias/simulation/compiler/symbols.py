"""Numbers that write down what is done with them.

A component's method is called once on such numbers (`simbias.simulation.compiler.symbolic_arrays` are NumPy's
arrays of them); what it computes is then a list of operations on single numbers, of which
`simbias.simulation.compiler.tracing` makes a kernel. Code that needs a value, because it decides by it or
hands it to something else than NumPy, gets a `TraceError`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

MOST = 3000  # operations and numbers: to compile 2,500 of them takes LLVM a minute, 300 some seconds


class TraceError(TypeError):
    """An operation on a symbol cannot be written down; the message names it."""


class Trace:
    """The operations that were asked for, each once.

    Numbers that are met become parameters of what is written; whole ones, as in `x / 2` and `1 + x`, are
    written as they are. No operation is left out because of a number's value, nor are equal numbers one
    parameter: models that differ in numbers have the same operations.
    """

    def __init__(self) -> None:
        self.symbols: list[Symbol] = []
        self._known: dict[tuple, Symbol] = {}

    def given(self, name: str) -> Symbol:
        """A number that what is written is given, by its name there."""
        return self._add("given", value=name)

    def number(self, value: Any, whole: bool = False) -> Symbol:
        """A number that the code knows; one that is `whole`, or comes of such, is written as it is."""
        if isinstance(value, complex | np.complexfloating):
            raise TraceError("it computes with complex numbers")
        if not whole and not isinstance(value, int | np.integer):
            return self._add("number", value=float(value))
        key = ("whole", float(value))
        if key not in self._known:
            self._known[key] = self._add("number", value=float(value), whole=True)
        return self._known[key]

    def operation(self, name: str, *operands: Symbol, truth: bool = False) -> Symbol:
        """An operation's result; of the same operation, the same one."""
        key = (name, *(operand.index for operand in operands))
        if key not in self._known:
            self._known[key] = self._add(name, operands, truth=truth)
        return self._known[key]

    def _add(
        self,
        name: str,
        operands: tuple[Symbol, ...] = (),
        value: Any = None,
        truth: bool = False,
        whole: bool = False,
    ) -> Symbol:
        """One more symbol."""
        if len(self.symbols) >= MOST:
            raise TraceError(f"it takes more than {MOST} operations, on single numbers")
        symbol = Symbol(self, name, operands, value, truth, whole)
        self.symbols.append(symbol)
        return symbol


class Symbol(NDArrayOperatorsMixin):
    """A number that is not known yet, or whether something holds."""

    __slots__ = ("index", "name", "operands", "trace", "truth", "value", "whole")

    def __init__(
        self, trace: Trace, name: str, operands: tuple[Symbol, ...], value: Any, truth: bool, whole: bool
    ) -> None:
        self.trace = trace
        self.index = len(trace.symbols)  # among all of the trace: after its operands
        self.name = name  # of the operation
        self.operands = operands
        self.value = value  # of a number; the name of what is given
        self.truth = truth  # whether it is a condition
        self.whole = whole  # whether it is a number that is written as it is

    def __hash__(self) -> int:
        return id(self)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        return arrays().applied(ufunc, method, inputs, options)

    def __array_function__(self, function: Callable, types: Any, arguments: Any, options: Any) -> Any:
        return arrays().called(function, arguments, options)

    def __getitem__(self, index: Any) -> Any:
        return arrays().array(self)[index]

    def __getattr__(self, name: str) -> Any:
        """An attribute that NumPy's numbers have too; NumPy looks up functions on elements by name."""
        if name.startswith("__"):
            raise AttributeError(name)
        if name in _BY_NAME:
            return lambda *others: _BY_NAME[name](self, *others)
        return getattr(arrays().array(self), name)


def arrays() -> Any:
    """The arrays of symbols, whose module knows this one."""
    from simbias.simulation.compiler import symbolic_arrays

    return symbolic_arrays


def refusal(what: str) -> Callable:
    """A method that raises."""

    def refuse(*_: Any) -> Any:
        raise TraceError(what)

    return refuse


Symbol.__bool__ = refusal("it decides by a value; np.where does not")  # type: ignore[attr-defined]
for _name in (
    "__float__",
    "__int__",
    "__index__",
    "__complex__",
    "__round__",
    "__trunc__",
    "__floor__",
    "__ceil__",
):
    setattr(
        Symbol,
        _name,
        refusal("it needs a value, as float(), math and arrays of np.zeros do; np.zeros_like does not"),
    )


def numeric(symbol: Symbol) -> Symbol:
    """A symbol as a number: 1 where a condition holds, else 0."""
    return symbol.trace.operation("indicator", symbol) if symbol.truth else symbol


def _truth(symbol: Symbol) -> Symbol:
    """A symbol as a condition."""
    return symbol if symbol.truth else symbol.trace.operation("is_true", symbol, truth=True)


def _operation(name: str, truth: bool = False) -> Callable[..., Symbol]:
    """An operation on numbers."""

    def operation(*symbols: Symbol) -> Symbol:
        return symbols[0].trace.operation(name, *map(numeric, symbols), truth=truth)

    return operation


def _of_conditions(name: str) -> Callable[..., Symbol]:
    """An operation on conditions."""

    def operation(*symbols: Symbol) -> Symbol:
        return symbols[0].trace.operation(name, *map(_truth, symbols), truth=True)

    return operation


def _of_bits(operation: Callable[..., Symbol]) -> Callable[..., Symbol]:
    """&, |, ^ and ~, of conditions alone."""

    def of_bits(*symbols: Symbol) -> Symbol:
        if not all(symbol.truth or symbol.name == "number" for symbol in symbols):
            raise TraceError("it needs the bits of a value")
        return operation(*symbols)

    return of_bits


add, subtract, multiply = _operation("add"), _operation("subtract"), _operation("multiply")
quotient, power, absolute = _operation("divide"), _operation("power"), _operation("abs")
square_root, floor = _operation("sqrt"), _operation("floor")
negative = _operation("negative")
less, less_equal = _operation("less", True), _operation("less_equal", True)
equal, unequal = _operation("equal", True), _operation("not_equal", True)
both, either, neither = _of_conditions("and"), _of_conditions("or"), _of_conditions("not")


def _extreme(name: str, of_known: str) -> Callable[[Symbol, Symbol], Symbol]:
    """The lesser or the greater; one that is known is a number, so that less has to be asked."""

    def extreme(a: Symbol, b: Symbol) -> Symbol:
        a, b = (b, a) if a.name == "number" else (a, b)
        return a.trace.operation(of_known if b.name == "number" else name, numeric(a), numeric(b))

    return extreme


lesser, greater = _extreme("minimum", "at_most"), _extreme("maximum", "at_least")


def sine(a: Symbol) -> Symbol:
    """A sine, which shares what it needs of the angle with the cosine."""
    return a.trace.operation("sin", a.trace.operation("angle", numeric(a)))


def cosine(a: Symbol) -> Symbol:
    """A cosine; see `sine`."""
    return a.trace.operation("cos", a.trace.operation("angle", numeric(a)))


def divide(a: Symbol, b: Symbol) -> Symbol:
    """A quotient; the product with the inverse of a known number takes less time."""
    if b.name == "number":
        with np.errstate(all="ignore"):
            return multiply(a, b.trace.number(np.divide(1.0, b.value), b.whole))
    return quotient(a, b)


def to_the_power(base: Symbol, exponent: Symbol) -> Symbol:
    """A power; of a small whole exponent products, as part of what is written."""
    known = exponent.value if exponent.name == "number" else np.nan
    if known == 0.5:
        return square_root(base)
    if known not in range(-16, 17) or known == 0:
        return power(base, exponent)
    product = None
    for bit in f"{abs(int(known)):b}":
        product = base if product is None else multiply(product, product)
        product = multiply(product, base) if bit == "1" and product is not base else product
    assert product is not None
    return product if known > 0 else product.trace.operation("inverse", numeric(product))


def choose(condition: Symbol, a: Symbol, b: Symbol) -> Symbol:
    """The first of two where a condition holds, else the second."""
    if a.truth and b.truth:
        return either(both(condition, a), both(neither(condition), b))
    return a.trace.operation("chosen", _truth(condition), numeric(a), numeric(b))


def _ceil(a: Symbol) -> Symbol:
    """The next whole number."""
    return negative(floor(negative(a)))


def _scaled(factor: float) -> Callable[[Symbol], Symbol]:
    """A product with a factor."""
    return lambda a: multiply(a, a.trace.number(factor))


def _different(a: Symbol, b: Symbol) -> Symbol:
    """Whether one of two conditions holds."""
    return either(both(a, neither(b)), both(neither(a), b))


OF_NUMPY = (  # functions of one number, which are written as they are
    *("arcsin", "arccos", "sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh"),
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p"),
)
# Elementwise functions of NumPy; the others cannot be written down.
RULES: Mapping[np.ufunc, Callable[..., Symbol]] = {
    np.add: add,
    np.subtract: subtract,
    np.multiply: multiply,
    np.true_divide: divide,
    np.negative: negative,
    np.positive: numeric,
    np.conjugate: numeric,
    np.power: to_the_power,
    np.float_power: to_the_power,
    np.square: lambda a: multiply(a, a),
    np.reciprocal: lambda a: a.trace.operation("inverse", numeric(a)),
    np.sqrt: square_root,
    np.hypot: lambda a, b: square_root(add(multiply(a, a), multiply(b, b))),
    np.absolute: absolute,
    np.fabs: absolute,
    np.sign: _operation("sign"),
    np.floor: floor,
    np.ceil: _ceil,
    np.trunc: lambda a: multiply(a.trace.operation("sign", numeric(a)), floor(absolute(a))),
    np.floor_divide: lambda a, b: floor(divide(a, b)),
    np.remainder: lambda a, b: subtract(a, multiply(b, floor(divide(a, b)))),
    np.deg2rad: _scaled(np.pi / 180),
    np.radians: _scaled(np.pi / 180),
    np.rad2deg: _scaled(180 / np.pi),
    np.degrees: _scaled(180 / np.pi),
    np.sin: sine,
    np.cos: cosine,
    np.tan: lambda a: quotient(sine(a), cosine(a)),
    **{getattr(np, name): _operation(name) for name in ("arctan", "arctan2", "copysign", *OF_NUMPY)},
    np.minimum: lesser,
    np.maximum: greater,
    np.less: less,
    np.less_equal: less_equal,
    np.greater: lambda a, b: less(b, a),
    np.greater_equal: lambda a, b: less_equal(b, a),
    np.equal: equal,
    np.not_equal: unequal,
    np.isnan: lambda a: unequal(a, a),
    np.isfinite: lambda a: a.trace.operation("finite", numeric(a), truth=True),
    np.logical_and: both,
    np.logical_or: either,
    np.logical_not: neither,
    np.logical_xor: _different,
    np.bitwise_and: _of_bits(both),
    np.bitwise_or: _of_bits(either),
    np.bitwise_xor: _of_bits(_different),
    np.invert: _of_bits(neither),
}
_BY_NAME = {ufunc.__name__: rule for ufunc, rule in RULES.items()}
