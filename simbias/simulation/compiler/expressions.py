"""Expressions of a config, such as `length * cos(angle)`, in NumPy.

A config may come from somebody else, so nothing in it is ever executed. An expression is parsed, checked
against a short list of allowed parts, and turned into a function of NumPy arrays, whose trace joins compiled
loops.
"""

from __future__ import annotations

import ast
import math
import operator
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from simbias.core.messages import quote
from simbias.core.records import Array

LENGTH, DEPTH = 1000, 60  # of an expression: characters, and nesting depth


def _as_text(value: Any) -> Any:
    """A number from a config, as an expression."""
    return repr(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Expression = Annotated[str, BeforeValidator(_as_text), Field(min_length=1, max_length=LENGTH)]

CONSTANTS = {"pi": math.pi}
OF_ONE: Mapping[str, Callable] = {"abs": np.abs, "sqrt": np.sqrt, "exp": np.exp, "sin": np.sin, "cos": np.cos}
OF_TWO: Mapping[str, Callable] = {"atan2": np.arctan2}
OF_MANY: Mapping[str, Callable] = {"min": np.minimum, "max": np.maximum}
OPERATORS: Mapping[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
EXPONENTS = (2, 3, 4)
ALLOWED = (
    f"+ - * / ** ({', '.join(map(str, EXPONENTS))}), {', '.join([*OF_ONE, *OF_TWO, *OF_MANY, *CONSTANTS])}"
)


class Expressions:
    """Several expressions, by name, of the components of one vector x, whose names are the variables.

    Constants are names that stand for numbers; names of `where` stand for expressions, which may use earlier
    ones. ValueError, in one line, if an expression uses something not allowed.
    """

    def __init__(
        self,
        expressions: Mapping[str, str],
        variables: Sequence[str],
        constants: Mapping[str, float] | None = None,
        where: Mapping[str, str] | None = None,
    ) -> None:
        parser = _Parser({**CONSTANTS, **(constants or {})}, variables)
        self._where = [parser.define(name, text) for name, text in (where or {}).items()]
        self._values = [parser.parse(name, text) for name, text in expressions.items()]

    def __call__(self, x: Array) -> Array:
        """Their values (..., k) at x (..., n)."""
        with np.errstate(all="ignore"):  # an overflow is not finite, and counts as failed
            known = [x[..., index] for index in range(x.shape[-1])]
            for value in self._where:
                known.append(value(known))
            rows = np.empty_like(x, np.float64, shape=(*x.shape[:-1], len(self._values)))
            for index, value in enumerate(self._values):
                rows[..., index] = value(known)
        return rows


Value = Callable[[Sequence[Any]], Any]  # of the variables (...), then of named expressions


class _Parser:
    """Turns expressions into functions."""

    def __init__(self, constants: Mapping[str, float], variables: Sequence[str]) -> None:
        self._names: dict[str, Value] = {}
        self._count = 0  # number of values known when expressions are computed
        for name in variables:
            self._add_next(name)
        for name, value in constants.items():
            self._add(name, _number(value))

    def define(self, name: str, text: str) -> Value:
        """Parse an expression whose name later ones may use."""
        value = self.parse(f"where.{name}", text)
        self._add_next(name)
        return value

    def parse(self, name: str, text: str) -> Value:
        """The parsed value of an expression."""
        try:
            parsed = ast.parse(text.strip(), mode="eval").body
            if _depth(parsed) > DEPTH:
                raise RecursionError
            return self._node(parsed)
        except (SyntaxError, MemoryError, RecursionError, OverflowError) as error:
            why = error.msg if isinstance(error, SyntaxError) else "too large"
            raise ValueError(f"{name}: {quote(text)} is not an expression: {why}") from error
        except _NotAllowedError as error:
            raise ValueError(f"{name}: {quote(text)}: {error}") from error

    def _add_next(self, name: str) -> None:
        """Let a name stand for the next known value."""
        self._add(name, operator.itemgetter(self._count))
        self._count += 1

    def _add(self, name: str, value: Value) -> None:
        """Define a name."""
        if name.isidentifier():
            name = unicodedata.normalize("NFKC", name)  # as in Python's expressions: a keyboard's µ becomes μ
        if name in self._names:
            raise ValueError(f"{name}: two things have this name")
        self._names[name] = value

    def _node(self, node: ast.AST) -> Value:
        """The value of a part of an expression."""
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return _number(value)
            case ast.Name() | ast.Subscript():
                name = ast.unparse(node)
                if name not in self._names:
                    raise _NotAllowedError(f"nothing is called {name}; available: {', '.join(self._names)}")
                return self._names[name]
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
                function = operator.neg if isinstance(sign, ast.USub) else operator.pos
                return _applied(function, self._node(operand))
            case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int() as exponent)):
                if exponent in EXPONENTS:
                    return _applied(operator.pow, self._node(base), _number(exponent))
            case ast.BinOp(left=left, op=operation, right=right) if type(operation) in OPERATORS:
                return _applied(OPERATORS[type(operation)], self._node(left), self._node(right))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, [self._node(argument) for argument in arguments])
        raise _NotAllowedError(f"{ast.unparse(node)} is not allowed; an expression may use {ALLOWED}")

    def _call(self, name: str, arguments: list[Value]) -> Value:
        """A call of one of the allowed functions."""
        if name in OF_MANY and len(arguments) >= 2:
            return reduce(lambda a, b: _applied(OF_MANY[name], a, b), arguments)
        functions = {1: OF_ONE, 2: OF_TWO}.get(len(arguments), {})
        if name in functions:
            return _applied(functions[name], *arguments)
        raise _NotAllowedError(
            f"{name} of {len(arguments)} values is not allowed; an expression may use {ALLOWED}"
        )


def _number(value: float) -> Value:
    """A finite number as a constant value."""
    number = np.float64(value)
    if not math.isfinite(number):
        raise _NotAllowedError("numbers must be finite")
    return lambda known: number


def _applied(function: Callable, *operands: Value) -> Value:
    """A function applied to values."""
    return lambda known: function(*(operand(known) for operand in operands))


def _depth(node: ast.AST) -> int:
    """The nesting depth of an expression's parts."""
    return 1 + max(map(_depth, ast.iter_child_nodes(node)), default=0)


class _NotAllowedError(Exception):
    """An expression uses a part that is not allowed; the message says what is allowed."""
