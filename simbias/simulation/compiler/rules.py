"""Elementwise functions of NumPy as operations on symbols."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from simbias.simulation.compiler.symbols import Symbol, TraceError, numeric


def truth(symbol: Symbol) -> Symbol:
    """A symbol as a condition."""
    return symbol if symbol.truth else symbol.trace.operation("is_true", symbol, truth=True)


def _operation(name: str, truth: bool = False, of: Callable = numeric) -> Callable[..., Symbol]:
    """An operation on numbers, or `of` conditions, that gives a number or a condition."""

    def operation(*symbols: Symbol) -> Symbol:
        return symbols[0].trace.operation(name, *map(of, symbols), truth=truth)

    return operation


def _of_bits(operation: Callable[..., Symbol]) -> Callable[..., Symbol]:
    """&, |, ^ and ~ of conditions, or of one and the number 0 or 1, which gives a number."""

    def of_bits(*symbols: Symbol) -> Symbol:
        numbers = [symbol for symbol in symbols if not symbol.truth]
        if not numbers:
            return operation(*symbols)
        if len(numbers) == len(symbols) or not all(each.whole and each.value in (0, 1) for each in numbers):
            raise TraceError("it needs the bits of a value")
        return numeric(operation(*symbols))

    return of_bits


add, subtract, multiply, quotient = map(_operation, ("add", "subtract", "multiply", "divide"))
power, square_root, absolute, negative = map(_operation, ("power", "sqrt", "abs", "negative"))
less, less_equal = _operation("less", True), _operation("less_equal", True)
equal, unequal = _operation("equal", True), _operation("not_equal", True)
inverse, sign, finite = _operation("inverse"), _operation("sign"), _operation("finite", True)
rest, nearest, with_sign = map(_operation, ("fmod", "rint", "copysign"))
both, either, neither = (_operation(name, True, of=truth) for name in ("and", "or", "not"))


def _extreme(name: str, of_known: str) -> Callable[[Symbol, Symbol], Symbol]:
    """The lesser or the greater, the second of equal zeros; it is simpler if the first is known."""

    def extreme(a: Symbol, b: Symbol) -> Symbol:
        if a.name == "number":
            return a.trace.operation(of_known, numeric(b), numeric(a))
        return a.trace.operation(name, numeric(a), numeric(b))

    return extreme


lesser, greater = _extreme("minimum", "at_most"), _extreme("maximum", "at_least")


def sine(a: Symbol) -> Symbol:
    """A sine, which shares the reduction of the angle with the cosine."""
    return a.trace.operation("sin", a.trace.operation("angle", numeric(a)))


def cosine(a: Symbol) -> Symbol:
    """A cosine; see `sine`."""
    return a.trace.operation("cos", a.trace.operation("angle", numeric(a)))


def divide(a: Symbol, b: Symbol) -> Symbol:
    """A quotient; by a known number, the faster product with its inverse, except in `_at_edges`."""
    if b.name == "number":
        with np.errstate(all="ignore"):
            product = multiply(a, b.trace.number(np.divide(1.0, b.value), b.whole))
        product.quotient_of = a, b
        return product
    return quotient(a, b)


def _itself(a: Symbol, most: int = 4) -> Symbol:
    """A number with its quotient restored, also within up to `most` sums and products with known numbers."""
    if most and a.quotient_of:
        return quotient(_itself(a.quotient_of[0], most - 1), a.quotient_of[1])
    if most and a.name in LINEAR and sum(bool(each.operands) for each in a.operands) == 1:
        return a.trace.operation(a.name, *(_itself(each, most - 1) for each in a.operands))
    return a


def _at_edges(operation: Callable[..., Symbol]) -> Callable[..., Symbol]:
    """An operation on true quotients, whose last bit matters at the operation's edges."""
    return lambda *symbols: operation(*map(_itself, symbols))


def _other_sign(r: Symbol, b: Symbol) -> Symbol:
    """Whether a remainder with the dividend's sign lacks the divisor's sign, which NumPy's remainder has."""
    zero = r.trace.number(0)
    return both(unequal(r, zero), _different(less(r, zero), less(b, zero)))


def _remainder(a: Symbol, b: Symbol) -> Symbol:
    """The remainder as in NumPy; a - b floor(a / b) would be off by b at edges."""
    r, zero = rest(a, b), a.trace.number(0)
    return choose(equal(r, zero), with_sign(zero, b), choose(_other_sign(r, b), add(r, b), r))


def _floor_divide(a: Symbol, b: Symbol) -> Symbol:
    """The floor of a quotient as in NumPy, from a multiple of b, so that it has no edges."""
    r, zero, share = rest(a, b), a.trace.number(0), quotient(a, b)
    whole = nearest(subtract(quotient(subtract(a, r), b), _other_sign(r, b)))
    whole = choose(equal(whole, zero), with_sign(zero, share), whole)
    return choose(equal(b, zero), share, whole)


def to_the_power(base: Symbol, exponent: Symbol) -> Symbol:
    """A power; for a small integer exponent, written as products."""
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
    return product if known > 0 else inverse(product)


def choose(condition: Symbol, a: Symbol, b: Symbol) -> Symbol:
    """The first of two where a condition holds, else the second."""
    if a.truth and b.truth:
        return either(both(condition, a), both(neither(condition), b))
    return a.trace.operation("chosen", truth(condition), numeric(a), numeric(b))


def _of_numbers_first(prefers: Callable[[Symbol, Symbol], Symbol]) -> Callable[[Symbol, Symbol], Symbol]:
    """The lesser or the greater; of a number and nan, the number."""
    return lambda a, b: choose(either(prefers(a, b), unequal(b, b)), a, b)


def _scaled(factor: float) -> Callable[[Symbol], Symbol]:
    """A product with a factor."""
    return lambda a: multiply(a, a.trace.number(factor))


def _different(a: Symbol, b: Symbol) -> Symbol:
    """Whether one of two conditions holds."""
    return either(both(a, neither(b)), both(neither(a), b))


LINEAR = ("add", "subtract", "multiply", "negative")
ROUNDED = ("floor", "ceil", "trunc", "rint")
OF_NUMPY = (  # functions of one number, written unchanged
    *("arcsin", "arccos", "sinh", "cosh", "tanh", "arcsinh", "arccosh", "arctanh"),
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p"),
)
# Elementwise functions of NumPy; others cannot be written down.
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
    np.reciprocal: inverse,
    np.sqrt: square_root,
    np.hypot: lambda a, b: square_root(add(multiply(a, a), multiply(b, b))),
    np.absolute: absolute,
    np.fabs: absolute,
    np.sign: sign,
    **{getattr(np, name): _at_edges(_operation(name)) for name in ROUNDED},
    np.fmod: _at_edges(rest),
    np.floor_divide: _at_edges(_floor_divide),
    np.remainder: _at_edges(_remainder),
    np.deg2rad: _scaled(np.pi / 180),
    np.radians: _scaled(np.pi / 180),
    np.rad2deg: _scaled(180 / np.pi),
    np.degrees: _scaled(180 / np.pi),
    np.sin: sine,
    np.cos: cosine,
    np.tan: lambda a: quotient(sine(a), cosine(a)),
    np.copysign: with_sign,
    **{getattr(np, name): _operation(name) for name in ("arctan", "arctan2", *OF_NUMPY)},
    np.minimum: lesser,
    np.maximum: greater,
    np.fmin: _of_numbers_first(less_equal),
    np.fmax: _of_numbers_first(lambda a, b: less_equal(b, a)),
    np.less: less,
    np.less_equal: less_equal,
    np.greater: lambda a, b: less(b, a),
    np.greater_equal: lambda a, b: less_equal(b, a),
    np.equal: equal,
    np.not_equal: unequal,
    np.isnan: lambda a: unequal(a, a),
    np.isfinite: finite,
    np.isinf: lambda a: both(equal(a, a), neither(finite(a))),
    np.logical_and: both,
    np.logical_or: either,
    np.logical_not: neither,
    np.logical_xor: _different,
    np.bitwise_and: _of_bits(both),
    np.bitwise_or: _of_bits(either),
    np.bitwise_xor: _of_bits(_different),
    np.invert: _of_bits(neither),
}
BY_NAME = {ufunc.__name__: rule for ufunc, rule in RULES.items()}
