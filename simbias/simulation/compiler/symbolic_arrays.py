"""NumPy's arrays of symbols, and functions of them: NumPy's, and kernels that have no formula."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from inspect import signature
from itertools import chain
from typing import Any

import numpy as np

from simbias.core import Kernel
from simbias.core.records import Array
from simbias.simulation.compiler.compilation import compiled_as
from simbias.simulation.compiler.rules import RULES, choose, truth
from simbias.simulation.compiler.symbols import Symbol, Trace, TraceError, numeric, refusal


class Symbols(np.ndarray):
    """An array whose elements are symbols and numbers."""

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        return applied(ufunc, method, inputs, options)

    def __array_function__(self, function: Callable, types: Any, arguments: Any, options: Any) -> Any:
        return called(function, arguments, options)

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, _truths(value, self) if all(_conditions(self)) else _numbers(value))

    def clip(self, *bounds: Any, **options: Any) -> Any:
        """The elements within bounds."""
        return called(np.clip, (self, *bounds), options)

    def astype(self, dtype: Any, *_: Any, copy: bool = True, **__: Any) -> Any:  # type: ignore[override]
        """The elements as floating-point numbers."""
        if not _double(dtype):
            raise TraceError("it turns values into whole numbers, conditions or single precision")
        return _numbers(self).view(Symbols) if copy or any(_conditions(self)) else self


for _name in ("ctypes", "data", "__array_interface__", "__array_struct__", "tobytes"):  # it holds no numbers
    setattr(Symbols, _name, property(refusal("it passes an array to code other than NumPy's")))


def array(values: Any) -> Symbols:
    """An array of symbols."""
    return np.array(values, object).view(Symbols)


def row(trace: Trace, name: str, size: int) -> Symbols:
    """A vector (1, size) that is an argument of the written function."""
    return array([[trace.given(f"{name}[{index}]") for index in range(size)]])


def symbols_in(values: Any, trace: Trace) -> np.ndarray:
    """A plain array of symbols: numbers become parameters, conditions 1 or 0."""
    return _numbers(_known(np.asarray(values), trace))


def _conditions(values: Any) -> Iterator[bool]:
    """Whether each element is a condition."""
    return (isinstance(each, Symbol) and each.truth for each in np.asarray(values, object).flat)


def _truths(values: Any, others: Any) -> Any:
    """Values as conditions, in the trace of some symbols."""
    trace = trace_of([others])
    return values if trace is None else _ALL_TRUE(_known(values, trace))


def _numbers(values: Any) -> np.ndarray:
    """Values as a plain array of symbols and numbers, without conditions."""
    return np.array(_AS_NUMBERS(np.asarray(values, object)), object)


def _double(dtype: Any) -> bool:
    """Whether this type is the double precision of symbols."""
    return dtype is None or np.dtype(dtype) in (np.float64, object)


def _folding(ufunc: np.ufunc, rule: Callable) -> Callable:
    """A rule that evaluates the function if all numbers are known."""

    def folded(*values: Symbol) -> Symbol:
        if all(value.name == "number" for value in values):
            made = ufunc(*(value.value for value in values))
            return values[0].trace.number(made, all(value.whole for value in values))
        return rule(*values)

    return folded


_IDENTITIES = {np.add: 0.0, np.multiply: 1.0, np.logical_and: True, np.logical_or: False}
_FOLDED = {
    ufunc: _folding(ufunc, rule)
    for ufunc, rule in RULES.items()
    if not ufunc.__name__.startswith(("bitwise", "inv"))
}
_ELEMENTWISE = {
    ufunc: np.frompyfunc(
        rule, ufunc.nin, 1, **({"identity": _IDENTITIES[ufunc]} if ufunc in _IDENTITIES else {})
    )
    for ufunc, rule in ({**RULES, **_FOLDED}).items()
}
_PRODUCTS = [getattr(np, name) for name in ("matmul", "vecdot", "matvec", "vecmat") if hasattr(np, name)]
_ALL_TRUE = np.frompyfunc(truth, 1, 1)
_AS_NUMBERS = np.frompyfunc(lambda each: numeric(each) if isinstance(each, Symbol) else each, 1, 1)
_CHOOSE = np.frompyfunc(choose, 3, 1)
_PASSED_ON = ("axis", "axes", "keepdims")  # options that select the operations
_KNOWN = (*_PASSED_ON, "out", "casting", "order", "subok")  # the last three change no number


def applied(ufunc: np.ufunc, method: str, inputs: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Write down an elementwise function of NumPy, or a matrix product."""
    if ufunc not in _ELEMENTWISE and ufunc not in _PRODUCTS:
        raise TraceError(f"np.{ufunc.__name__} of values is not supported")
    _check_options(ufunc, options)
    trace = trace_of(inputs)
    passed_on = {name: options[name] for name in _PASSED_ON if name in options}
    if trace is None:
        made = getattr(ufunc, method)(*map(_plain, inputs), **passed_on)
    elif method == "__call__" and all(isinstance(each, Symbol) for each in inputs) and ufunc in RULES:
        made = RULES[ufunc](*inputs)
    else:
        operands = [_known(each, trace) for each in inputs]
        by_elements = method in ("__call__", "outer")
        if options.get("dtype") is not None or (ufunc in (np.add, np.multiply) and not by_elements):
            operands = list(map(_numbers, operands))  # conditions are counted
        made = getattr(_ELEMENTWISE.get(ufunc, ufunc), method)(*operands, **passed_on)
        if by_elements and all(map(all, map(_conditions, operands))):
            made = _of_conditions(ufunc, made)
    for target in options.get("out") or ():
        if target is not None and not isinstance(target, Symbol):
            target[...] = made
            return target
    return _viewed(made)


def _check_options(ufunc: np.ufunc, options: Mapping[str, Any]) -> None:
    """Refuse options that change the result."""
    for option, value in options.items():
        known = option in _KNOWN or (option == "where" and value is True)
        if option == "dtype":
            known = _double(value) or ufunc in (np.logical_and, np.logical_or)  # np.any passes bool
        if not known:
            raise TraceError(f"np.{ufunc.__name__}: {option}= is not supported")


def _of_conditions(ufunc: np.ufunc, made: Any) -> Any:
    """The result for arrays of conditions, in the type that NumPy gives it: their sum is a condition."""
    try:
        dtype = ufunc.resolve_dtypes((np.dtype(bool),) * ufunc.nin + (None,) * ufunc.nout)[-1]
    except TypeError:
        dtype = np.dtype(np.float16)  # a type that NumPy would not return
    if dtype == np.float16:
        raise TraceError(f"np.{ufunc.__name__} of conditions is not supported")
    return _ALL_TRUE(np.asarray(made, object)) if dtype.kind == "b" else made


def _plain(values: Any) -> Any:
    """Numbers in an array that may also hold symbols."""
    return np.asarray(values, np.float64) if isinstance(values, Symbols) else values


def trace_of(values: Any) -> Trace | None:
    """The trace of the first symbol in arrays and lists of them, if there is one."""
    for value in values:
        if isinstance(value, Symbol):
            return value.trace
        if isinstance(value, np.ndarray) and value.dtype != object:
            continue
        if isinstance(value, np.ndarray | list | tuple):
            symbols = (each for each in np.asarray(value, object).flat if isinstance(each, Symbol))
            if (found := next(symbols, None)) is not None:
                return found.trace
    return None


def _known(values: Any, trace: Trace) -> np.ndarray:
    """Values as a plain array of symbols; numbers become parameters once, not for each row."""
    if isinstance(values, Symbol):
        return np.asarray(array(values))
    plain = np.asarray(values)
    symbols = (each if isinstance(each, Symbol) else trace.number(each) for each in plain.flat)
    return np.fromiter(symbols, object, plain.size).reshape(plain.shape)


def called(function: Callable, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Any other NumPy function: one defined here, or NumPy's own if built from elementwise functions."""
    name = f"{function.__module__}.{function.__name__}".replace("numpy.", "np.", 1)
    options = {option: value for option, value in options.items() if value is not None}
    try:
        if own := _FUNCTIONS.get(function):
            if unknown := [option for option in options if option not in signature(own).parameters]:
                raise TraceError(f"{unknown[0]}= is not supported")
            return own(*arguments, **options)
        arguments, options = _arrays(tuple(arguments)), {key: _arrays(each) for key, each in options.items()}
        return _viewed(np.ndarray.__array_function__(_ANY, function, (Symbols,), arguments, options))
    except TraceError as error:
        raise TraceError(f"{name}: {error}") from error
    except TypeError as error:
        raise TraceError(f"{name} of values is not supported") from error


_ANY = np.empty(0, object).view(Symbols)


def _arrays(values: Any) -> Any:
    """Arguments with single symbols turned into arrays."""
    if isinstance(values, Symbol):
        return array(values)
    return type(values)(map(_arrays, values)) if type(values) in (list, tuple) else values


def _viewed(made: Any) -> Any:
    """A result with plain arrays of symbols turned into `Symbols`."""
    if isinstance(made, np.ndarray) and made.dtype == object:
        conditions = list(_conditions(made))
        return (_numbers(made) if any(conditions) and not all(conditions) else made).view(Symbols)
    return type(made)(map(_viewed, made)) if type(made) in (list, tuple) else made


def _where(condition: Any, a: Any, b: Any) -> Any:
    trace = trace_of([condition, a, b])
    if trace is None:
        return np.where(*map(_plain, (condition, a, b)))
    return _viewed(_CHOOSE(*(_known(each, trace) for each in (condition, a, b))))


def _clip(a: Any, a_min: Any = None, a_max: Any = None, *, min: Any = None, max: Any = None) -> Any:  # noqa: A002 (NumPy's)
    low, high = (a_min if min is None else min), (a_max if max is None else max)
    raised = a if low is None else np.maximum(low, a)  # in this order, a zero keeps its sign
    return raised if high is None else np.minimum(high, raised)


def _select(conditions: Sequence[Any], choices: Sequence[Any], default: Any = 0.0) -> Any:
    for condition, choice in zip(reversed(conditions), reversed(choices), strict=True):
        default = np.where(condition, choice, default)
    return default


def _full_like(a: Any, fill_value: Any, dtype: Any = None, shape: Any = None) -> Symbols:
    of_conditions = all(_conditions(a)) if dtype is None else np.dtype(dtype) == bool
    if not (of_conditions or _double(dtype)):
        raise TraceError("dtype= is not supported")
    filled = np.broadcast_to(fill_value, np.shape(a) if shape is None else shape)
    return array(_truths(filled, a) if of_conditions else filled)


def _filled(value: float) -> Callable:
    """A function that makes an array of a given array's shape, filled with a number."""
    return lambda a, dtype=None, shape=None: _full_like(a, value, dtype, shape)


def _interp(x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None) -> Any:
    """Interpolation of a constant table: the row is selected, then the value is computed as in NumPy."""
    if trace_of([xp, fp, left, right]) or np.size(xp) < 2:
        raise TraceError("a table of values, or of one row, is not supported")
    with np.errstate(all="ignore"):
        rows = np.array([xp[:-1], fp[:-1], np.diff(fp) / np.diff(xp)], np.float64).T
    start, value, slope = rows[0]
    for row in rows[1:]:
        start, value, slope = (
            np.where(x >= row[0], *pair) for pair in zip(row, (start, value, slope), strict=True)
        )
    within = np.where(x >= xp[-1], fp[-1], value + slope * (x - start))
    above = within if right is None else np.where(x > xp[-1], right, within)
    return np.where(x < xp[0], fp[0] if left is None else left, above)


def _norm(x: Any, ord: Any = None, axis: int | None = None, keepdims: bool = False) -> Any:  # noqa: A002 (NumPy's)
    x = np.asanyarray(x)
    if ord not in (None, 2) or (ord == 2 and axis is None and x.ndim > 1) or isinstance(axis, tuple):
        raise TraceError("this norm is not supported")
    return np.sqrt(np.sum(np.square(x), axis=axis, keepdims=keepdims))


def _determinant(A: Any) -> Any:
    """The determinant of matrices (..., n, n), by the first row's minors."""
    n = A.shape[-1]
    if n > ADJUGATE:
        raise TraceError(f"the determinant of more than {ADJUGATE} rows is not supported")
    if n == 1:
        return A[..., 0, 0]
    terms = [A[..., 0, j] * _cofactor(A, 0, j) for j in range(n)]
    return sum(terms[1:], terms[0])


ADJUGATE = 3  # rows of matrices that are always inverted by their minors


def _cofactor(A: Any, i: int, j: int) -> Any:
    """The signed minor without row i and column j."""
    minor = _determinant(np.delete(np.delete(A, i, axis=-2), j, axis=-1))
    return minor if (i + j) % 2 == 0 else -minor


def _inverse(A: Any) -> Any:
    n = A.shape[-1]
    if n > ADJUGATE:
        return _solve(A, np.eye(n))
    if n == 1:
        return 1.0 / A
    rows = [[_cofactor(A, j, i) for j in range(n)] for i in range(n)]
    first = [A[..., 0, j] * rows[j][0] for j in range(n)]
    scale = 1.0 / sum(first[1:], first[0])
    return np.stack([np.stack([each * scale for each in one], axis=-1) for one in rows], axis=-2)


def _solve(A: Any, b: Any) -> Any:
    """Solve linear systems; large ones by elimination without pivots, which mass matrices do not need."""
    n = A.shape[-1]
    if np.ndim(b) == 1:
        return _solve(A, b[:, None])[..., 0]
    if n <= ADJUGATE:
        return _inverse(A) @ b
    M = [[A[..., i, j] for j in range(n)] for i in range(n)]
    B = [b[..., i, :] for i in range(n)]
    for k in range(n):
        scale = 1.0 / M[k][k]
        for i in range(k + 1, n):
            factor = M[i][k] * scale
            for j in range(k + 1, n):
                M[i][j] = M[i][j] - factor * M[k][j]
            B[i] = B[i] - factor[..., None] * B[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            B[k] = B[k] - M[k][j][..., None] * B[j]
        B[k] = B[k] / M[k][k][..., None]
    return np.stack(np.broadcast_arrays(*B), axis=-2)


_FUNCTIONS: Mapping[Callable, Callable] = {
    np.where: _where,
    np.clip: _clip,
    np.select: _select,
    np.zeros_like: _filled(0.0),
    np.empty_like: _filled(0.0),
    np.ones_like: _filled(1.0),
    np.full_like: _full_like,
    np.interp: _interp,
    np.linalg.norm: _norm,
    np.linalg.det: lambda A: _determinant(np.asanyarray(A)),
    np.linalg.inv: lambda A: _inverse(np.asanyarray(A)),
    np.linalg.solve: lambda A, b: _solve(np.asanyarray(A), np.asanyarray(b)),
}


def is_traced(*vectors: Array) -> bool:
    """Whether one of these vectors holds symbols."""
    return any(vector.dtype == object for vector in vectors)


def traced_call(owner: Any, kernel: Kernel, size: int, *vectors: Array) -> Array:
    """A kernel's results (..., size) for vectors (..., .) of symbols and numbers; its owner is kept."""
    trace, shape = trace_of(vectors), np.broadcast_shapes(*(vector.shape[:-1] for vector in vectors))
    assert trace is not None
    trace.kept.append(owner)
    columns = [
        np.broadcast_to(symbols_in(each, trace), (*shape, each.shape[-1])).reshape(-1, each.shape[-1])
        for each in vectors
    ]
    function, parameters = _of_columns(kernel.function), list(map(trace.number, kernel.parameters.tolist()))
    made = [trace.call(function, *row, parameters, size=size) for row in zip(*columns, strict=True)]
    return array(made).reshape(*shape, size)


@cache
def _of_columns(function: Callable) -> Callable:
    """A function of numbers that also takes columns of them in Python; compiled code calls it as it is."""

    @compiled_as(function)
    def of_columns(*vectors: tuple[Any, ...]) -> tuple[Array, ...]:
        sizes = np.cumsum([len(vector) for vector in vectors])[:-1]
        given = np.stack(np.broadcast_arrays(*chain.from_iterable(vectors)), axis=-1)
        rows = given.reshape(-1, given.shape[-1]).tolist()
        made = np.array([function(*map(tuple, np.split(row, sizes))) for row in rows])
        return tuple(np.moveaxis(made.reshape(*given.shape[:-1], -1), -1, 0))

    return of_columns
