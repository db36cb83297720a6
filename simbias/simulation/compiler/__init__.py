"""The compiler: traces components in NumPy, writes them for Numba, and runs them in SIMD lanes.

Everything used elsewhere is imported from here.

| purpose | modules |
| --- | --- |
| components that have a kernel, or are fast in NumPy | `kernels`, `choices`, `trigonometry` |
| compiling | `compilation` |
| kernels for all lanes at once | `lanes` |
| components that are written in YAML | `expressions` |
| tables that a policy looks up by the time | `tables` |
| kernels of a model, its policy and cost | `tracing`, `symbols`, `symbolic_arrays`, `rules`, `agreement` |
| a policy's formulas, in C and in Python | `tracing`, `written` |
| the loops that run them | `closed_loop`, `open_loop`, `loop` |
"""

# ruff: noqa: F401  (names for others to import)

from simbias.simulation.compiler.agreement import points_among, points_of
from simbias.simulation.compiler.choices import at_least, at_most
from simbias.simulation.compiler.closed_loop import LoopKernels, compile_closed_loop
from simbias.simulation.compiler.compilation import compiled_as, function_of
from simbias.simulation.compiler.expressions import Expression, Expressions
from simbias.simulation.compiler.kernels import LANES, elementwise
from simbias.simulation.compiler.lanes import broadcast, cosine_of_turns, everywhere, exp, fma, load, store
from simbias.simulation.compiler.loop import Function, constant, in_threads, sum_of
from simbias.simulation.compiler.open_loop import compile_open_loop
from simbias.simulation.compiler.symbolic_arrays import is_traced, traced_call
from simbias.simulation.compiler.tables import scheduled
from simbias.simulation.compiler.tracing import (
    PolicyKernel,
    formulas_of,
    of_bias,
    of_cost,
    of_nominal,
    parts_of,
)
from simbias.simulation.compiler.trigonometry import arctan, sincos
from simbias.simulation.compiler.written import NUMPY, C, Formulas
