"""Numbers of sixteen rollouts in lockstep, one in each lane of a vector register.

A type for compiled functions: `load` and `store` move a row of an array, `everywhere` fills all lanes with
a number, `broadcast` with an element of an array, and `+`, `-`, `*` act lane by lane. The result in a lane
does not depend on the others. Without this type, the compiler keeps sums in memory, or vectorises them over
the samples and reduces each at its end.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending, float32, int64, types
from numba.core import cgutils
from numba.extending import models, overload, register_model

from simbias.simulation.compiler.kernels import LANES

ROWS = float32[:, ::1]
LINE = float32[::1]
_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTEGERS = ir.VectorType(ir.IntType(32), LANES)
intrinsic: Any = extending.intrinsic  # its annotations include the context as an argument
_UNALIGNED = 4  # bytes; NumPy's arrays are aligned to 16 at least, which gains nothing on current processors


class Lanes(types.Type):
    """Numba's type of a vector register with one float in each lane."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({LANES})")


REGISTERS = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """A vector register."""

    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _FLOATS)


def _constant(vector: ir.VectorType, value: float) -> ir.Constant:
    """The same value in every lane."""
    return ir.Constant(vector, [ir.Constant(vector.element, value)] * LANES)


def _overload(function: Callable, instruction: str) -> None:
    """Map Python's operator to an instruction, lane by lane."""

    @intrinsic
    def operation(context, a, b):
        def generate(context, builder, signature, arguments):
            return getattr(builder, instruction)(*arguments)

        return REGISTERS(a, b), generate

    @overload(function)
    def operate(a, b):
        if isinstance(a, Lanes) and isinstance(b, Lanes):
            return lambda a, b: operation(a, b)


for _function, _instruction in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _overload(_function, _instruction)


def _address(context, builder, array_type, array, index):
    """The address of the first element of a row of LANES, or of the elements from an index on."""
    data = context.make_array(array_type)(context, builder, array).data
    elements = LANES if array_type.ndim == 2 else 1
    offset = builder.mul(index, ir.Constant(ir.IntType(64), elements))
    return builder.bitcast(builder.gep(data, [offset]), _FLOATS.as_pointer())


@intrinsic
def load(context, array, index):
    """A row of an array (k, LANES), or the LANES elements of an array (k,) from an index on."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments)
        return builder.load(address, align=_UNALIGNED)

    return REGISTERS(ROWS if array.ndim == 2 else LINE, int64), generate


@intrinsic
def as_integers(context, array):
    """The same memory as integers; NumPy's `view` would take 7% of a loop's compile time."""
    integers = types.Array(int64, array.ndim, array.layout)

    def generate(context, builder, signature, arguments):
        same = ir.Constant(context.get_value_type(integers), ir.Undefined)
        for place, kind in enumerate(same.type.elements):
            part = builder.extract_value(arguments[0], place)
            part = part if part.type == kind else builder.bitcast(part, kind)  # casts only the address
            same = builder.insert_value(same, part, place)
        context.nrt.incref(builder, integers, same)
        return same

    return integers(array), generate


@intrinsic
def store(context, array, index, lanes):
    """Store lanes where `load` finds them."""

    def generate(context, builder, signature, arguments):
        address = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], address, align=_UNALIGNED)
        return context.get_dummy_value()

    return types.void(ROWS if array.ndim == 2 else LINE, int64, REGISTERS), generate


def _in_every_lane(builder, value):
    """A register filled with a number."""
    one = builder.insert_element(_constant(_FLOATS, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, _constant(_FLOATS, ir.Undefined), _constant(_INTEGERS, 0))


@intrinsic
def everywhere(context, value):
    """A number in every lane."""

    def generate(context, builder, signature, arguments):
        return _in_every_lane(builder, arguments[0])

    return REGISTERS(float32), generate


@intrinsic
def broadcast(context, array, index):
    """An element of an array (k,), in every lane.

    Python's indexing first checks for negative indices, which takes longer than a product.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        value = builder.load(builder.gep(data, [arguments[1]]))
        return _in_every_lane(builder, value)

    return REGISTERS(LINE, int64), generate


def _call(builder, name, arguments):
    """A call of LLVM's own vector function of this name."""
    function = ir.FunctionType(_FLOATS, [_FLOATS] * len(arguments))
    name = f"llvm.{name}.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), arguments)


@intrinsic
def fma(context, a, b, c):
    """a b + c, rounded once if the processor supports it.

    If the compiler chose which products to fuse with sums, it would do so differently on each processor.
    """

    def generate(context, builder, signature, arguments):
        return _call(builder, "fmuladd", arguments)

    return REGISTERS(a, b, c), generate


@intrinsic
def _rounded(context, lanes):
    """Round to the nearest integers."""

    def generate(context, builder, signature, arguments):
        return _call(builder, "rint", arguments)

    return REGISTERS(lanes), generate


@intrinsic
def _power_of_two(context, lanes):
    """2 to the power of integers, by setting the bits of the exponent."""

    def generate(context, builder, signature, arguments):
        exponent = builder.add(builder.fptosi(arguments[0], _INTEGERS), _constant(_INTEGERS, 127))
        return builder.bitcast(builder.shl(exponent, _constant(_INTEGERS, 23)), _FLOATS)

    return REGISTERS(lanes), generate


@intrinsic
def _at_least(context, lanes, least):
    """The greater one, lane by lane."""

    def generate(context, builder, signature, arguments):
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return REGISTERS(lanes, least), generate


# Its exp is below single precision's resolution at 1; the square is still normal: subnormals are 100 times
# slower.
_LEAST = np.float32(-40.0)
_LN_2 = np.float32(np.log(2.0))
_LOG2_E = np.float32(1.0 / np.log(2.0))
_MINUS_TWO, _ONE = np.float32(-2.0), np.float32(1.0)
# sin(pi r) / r to single precision, of |r| <= 1/2, in powers of r^2 from the highest
_SINE = tuple(
    np.float32((-1) ** i * np.pi ** (2 * i + 1) / math.factorial(2 * i + 1)) for i in (5, 4, 3, 2, 1, 0)
)
_SERIES = tuple(np.float32(1.0 / factorial) for factorial in (720.0, 120.0, 24.0, 6.0, 2.0, 1.0, 1.0))


def exp(v):
    """exp of v <= 0, to 1e-6 relative."""
    v = _at_least(v, everywhere(_LEAST))
    n = _rounded(v * everywhere(_LOG2_E))
    remainder = fma(n, everywhere(-_LN_2), v)
    series = everywhere(_SERIES[0])
    for coefficient in _SERIES[1:]:
        series = fma(series, remainder, everywhere(coefficient))
    return series * _power_of_two(n)


def cosine_of_turns(v):
    """cos(2 pi v), to 1e-6 and the resolution of v in single precision."""
    r = v - _rounded(v)
    square = r * r
    series = everywhere(_SINE[0])
    for coefficient in _SINE[1:]:
        series = fma(series, square, everywhere(coefficient))
    sine = series * r  # sine of pi r: the cosine is 1 - 2 sine^2
    return fma(everywhere(_MINUS_TWO) * sine, sine, everywhere(_ONE))
