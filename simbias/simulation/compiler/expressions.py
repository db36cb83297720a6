"""Expressions of a config, such as `length * cos(angle)`: for NumPy's arrays, and in the compiled loop.

A config may be somebody else's, so nothing of it is ever run. It is parsed, held against a short list of
what an expression may be made of, and written anew: names become elements of a vector, numbers become
parameters. So a loop is compiled once for expressions that differ in numbers only.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from simbias.core import Kernel
from simbias.core.messages import quote
from simbias.core.records import Array
from simbias.simulation.compiler.choices import greater, lesser
from simbias.simulation.compiler.compilation import function_of
from simbias.simulation.compiler.kernels import elementwise
from simbias.simulation.compiler.trigonometry import sincos

LENGTH, DEPTH = 1000, 60  # of an expression: characters, and parts within parts


def _as_text(value: Any) -> Any:
    """A number of a config, as an expression."""
    return repr(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Expression = Annotated[str, BeforeValidator(_as_text), Field(min_length=1, max_length=LENGTH)]


CONSTANTS = {"pi": math.pi}
OF_ONE = {"abs": "abs({})", "sqrt": "np.sqrt({})", "sin": "sincos({})[0]", "cos": "sincos({})[1]"}
OF_TWO = {"atan2": "np.arctan2({}, {})"}
OF_MANY = {"min": "lesser({}, {})", "max": "greater({}, {})"}
OPERATORS: Mapping[type, str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
EXPONENTS = (2, 3, 4)
ALLOWED = (
    f"+ - * / ** ({', '.join(map(str, EXPONENTS))}), {', '.join([*OF_ONE, *OF_TWO, *OF_MANY, *CONSTANTS])}"
)


class Expressions:
    """Several expressions of the components of one vector x.

    Parameters
    ----------
    expressions
        Their texts, by name: what is computed of x (..., n), in this order.
    variables
        What the components of x are called.
    constants
        Names that stand for numbers.
    where
        Names that stand for expressions, which may use those before them.

    Raises
    ------
    ValueError
        If an expression uses what it may not; in one line that names it.
    """

    def __init__(
        self,
        expressions: Mapping[str, str],
        variables: Sequence[str],
        constants: Mapping[str, float] | None = None,
        where: Mapping[str, str] | None = None,
    ) -> None:
        writer = _Writer(variables, {**CONSTANTS, **(constants or {})})
        lines = [writer.assign(name, text) for name, text in (where or {}).items()]
        values = [writer.write(name, text) for name, text in expressions.items()]
        lines.append(f"return ({''.join(f'{value}, ' for value in values)})")
        text = "def expressions(x, p):\n    " + "\n    ".join(lines) + "\n"
        names = {"np": np, "sincos": sincos, "lesser": lesser, "greater": greater}
        function = function_of(text, "expressions", **names)
        self.kernel = Kernel(function, np.array(writer.numbers, dtype=np.float64))

    def __call__(self, x: Array) -> Array:
        """Their values (..., k) at x (..., n)."""
        return elementwise(self.kernel.function, x, parameters=self.kernel.parameters)


class _Writer:
    """Writes expressions anew, in Python, of x and of the numbers p."""

    def __init__(self, variables: Sequence[str], constants: Mapping[str, float]) -> None:
        self.numbers: list[float] = []
        self._names = {variable: f"x[{index}]" for index, variable in enumerate(variables)}
        self._given = list(variables)
        for name, value in constants.items():
            self._add(name, self._number(value))

    def assign(self, name: str, text: str) -> str:
        """A line that gives an expression a name for those after it."""
        line = f"v{len(self._names)} = {self.write(name, text)}"
        self._add(name, line.partition(" = ")[0])
        return line

    def write(self, name: str, text: str) -> str:
        """An expression, in Python."""
        try:
            parsed = ast.parse(text.strip(), mode="eval").body
            if _depth(parsed) > DEPTH:
                raise RecursionError
            return self._node(parsed)
        except (SyntaxError, MemoryError, RecursionError, OverflowError) as error:
            why = error.msg if isinstance(error, SyntaxError) else "too large"
            raise ValueError(f"{name}: {quote(text)} is no expression: {why}") from error
        except _NotAllowedError as error:
            raise ValueError(f"{name}: {quote(text)}: {error}") from error

    def _add(self, name: str, written: str) -> None:
        """Let a name have a meaning."""
        if name in self._names:
            raise ValueError(f"{name}: two things have this name")
        self._names[name] = written

    def _number(self, value: float) -> str:
        """A number, as a parameter."""
        number = float(value)
        if not math.isfinite(number):
            raise _NotAllowedError("numbers have to be finite")
        self.numbers.append(number)
        return f"p[{len(self.numbers) - 1}]"

    def _node(self, node: ast.AST) -> str:
        """A part of an expression, in Python."""
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return self._number(value)
            case ast.Name() | ast.Subscript():
                name = ast.unparse(node)
                if name not in self._names:
                    raise _NotAllowedError(f"nothing is called {name}; there is {', '.join(self._names)}")
                return self._names[name]
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
                return f"({'-' if isinstance(sign, ast.USub) else '+'}{self._node(operand)})"
            case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant(value=int() as exponent)):
                if exponent in EXPONENTS:
                    return f"({self._node(base)} ** {int(exponent)})"
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPERATORS:
                return f"({self._node(left)} {OPERATORS[type(operator)]} {self._node(right)})"
            case ast.Call(func=ast.Name(id=function), args=arguments, keywords=[]):
                return self._call(function, [self._node(argument) for argument in arguments])
        raise _NotAllowedError(f"{ast.unparse(node)} is not allowed; an expression may use {ALLOWED}")

    def _call(self, function: str, arguments: list[str]) -> str:
        """A call of one of the functions that there are."""
        if function in OF_ONE and len(arguments) == 1:
            return OF_ONE[function].format(*arguments)
        if function in OF_TWO and len(arguments) == 2:
            return OF_TWO[function].format(*arguments)
        if function in OF_MANY and len(arguments) >= 2:
            value, *others = arguments
            for other in others:
                value = OF_MANY[function].format(value, other)
            return value
        raise _NotAllowedError(
            f"there is no {function} of {len(arguments)} values; an expression may use {ALLOWED}"
        )


def _depth(node: ast.AST) -> int:
    """How many parts lie within each other."""
    return 1 + max(map(_depth, ast.iter_child_nodes(node)), default=0)


class _NotAllowedError(Exception):
    """What an expression may not use; the message says what it may."""
