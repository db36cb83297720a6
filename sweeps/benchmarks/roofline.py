"""How near a simulated step is to what the processor can do.

`python sweeps/benchmarks/roofline.py` prints a table. Operations are counted by running kernels on symbols;
what is computed twice from the same numbers counts once. The peak is that of fused products and sums in
registers, measured in the same run on the same thread, so that a busy machine changes the shares little;
sums without products could reach half of it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any
from unittest.mock import patch

import closed_loop
import numpy as np
from numba import njit, set_num_threads
from threadpoolctl import threadpool_limits

import simbias
from simbias.learning.bias.none import ZeroBias
from simbias.simulation.compiler import LANES, everywhere, fma, of_cost, parts_of, store
from simbias.simulation.compiler.trigonometry import _by_polynomials
from simbias.trial.study import Study

REPETITIONS = 200_000
CHAINS = 12  # of fused products and sums that do not wait for each other
EXPONENTIAL = 20  # operations of `simbias.simulation.compiler.lanes.exp`


class Symbol:
    """A number that is not known; each operation on it is noted once."""

    noted: dict[tuple[Any, ...], Symbol]

    def __init__(self, *operation: Any) -> None:
        self.operation = operation

    @staticmethod
    def of(name: str, *operands: Any) -> Symbol:
        """The result of an operation, the same for the same operands."""
        key = (name, *(id(each) if isinstance(each, Symbol) else float(each) for each in operands))
        return Symbol.noted.setdefault(key, Symbol(name, *operands))

    def __add__(self, other: Any) -> Symbol:
        return Symbol.of("+", self, other)

    def __sub__(self, other: Any) -> Symbol:
        return Symbol.of("-", self, other)

    def __rsub__(self, other: Any) -> Symbol:
        return Symbol.of("-", other, self)

    def __mul__(self, other: Any) -> Symbol:
        return Symbol.of("*", self, other)

    def __truediv__(self, other: Any) -> Symbol:
        return Symbol.of("/", self, other)

    def __rtruediv__(self, other: Any) -> Symbol:
        return Symbol.of("/", other, self)

    def __pow__(self, exponent: int) -> Symbol:
        return self * self if exponent == 2 else Symbol.of("**", self, exponent)

    def __neg__(self) -> Symbol:
        return Symbol.of("negative", self)

    def __abs__(self) -> Symbol:
        return Symbol.of("abs", self)

    def __floor__(self) -> Symbol:
        return Symbol.of("floor", self)

    def sqrt(self) -> Symbol:
        return Symbol.of("sqrt", self)

    def __lt__(self, other: Any) -> bool:  # of min and max
        Symbol.of("<", self, other)
        return True

    __gt__ = __lt__
    __radd__, __rmul__ = __add__, __mul__


def symbols(count: int) -> tuple[Symbol, ...]:
    """So many unknown numbers."""
    return tuple(Symbol() for _ in range(count))


def operations(study: Study, noisy: bool) -> int:
    """Of a step without a bias: criteria, output, control, model and cost."""
    Symbol.noted = {}
    task = study.task
    measure, control, step, _ = (part.kernel for part in parts_of(study.model()))
    terms = of_cost(study.cost, task).kernel
    x, t = symbols(len(task.states)), Symbol()
    extremes = {name: partial(Symbol.of, name) for name in ("at_most", "at_least", "lesser", "greater")}
    with ExitStack() as stack:
        for function in (measure.function, control.function, step.function, terms.function):
            known = {name: each for name, each in extremes.items() if name in function.__globals__}
            stack.enter_context(patch.dict(function.__globals__, known | {"sincos": _by_polynomials}))
        stack.enter_context(patch("simbias.robots.bongoboard.equations.sincos", _by_polynomials))
        measures = measure.function(x, measure.parameters)
        for value, criterion in zip(measures, task.criteria, strict=True):
            Symbol.of("<=", value, criterion.limit)
        seen = tuple(value + Symbol() for value in x) if noisy else x
        u, _ = control.function(symbols(control.size), seen, t, (), control.constants)
        force = tuple(value + Symbol() for value in u) if noisy else u
        x_next = step.function(x, force, symbols(len(step.parameters)))
        corrected = tuple(value + Symbol() for value in x_next)
        for value in terms.function(corrected, u, t, terms.parameters):
            value + Symbol()
    return len(Symbol.noted)


def operations_of_gp(N: int, M: int, r: int = 7, n: int = 6) -> int:
    """Of a correction: distances, exponentials, means, and the variance through M points."""
    return N * (3 * r + 1 + EXPONENTIAL + 2 * n) + M**2


@njit(nogil=True, error_model="numpy")
def chains(repetitions, out):  # type: ignore[no-untyped-def]
    """CHAINS fused products and sums, again and again."""
    a, b = everywhere(np.float32(0.999)), everywhere(np.float32(0.001))
    v0 = v1 = v2 = v3 = v4 = v5 = v6 = v7 = v8 = v9 = v10 = v11 = b
    for _ in range(repetitions):
        v0, v1, v2, v3 = fma(v0, a, b), fma(v1, a, b), fma(v2, a, b), fma(v3, a, b)
        v4, v5, v6, v7 = fma(v4, a, b), fma(v5, a, b), fma(v6, a, b), fma(v7, a, b)
        v8, v9, v10, v11 = fma(v8, a, b), fma(v9, a, b), fma(v10, a, b), fma(v11, a, b)
    for row, v in enumerate((v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11)):
        store(out, row, v)


def peak() -> int:
    """Single-precision operations of a run of chains."""
    chains(REPETITIONS, np.empty((CHAINS, LANES), np.float32))
    return 2 * REPETITIONS * CHAINS * LANES


def best(run: Callable[[], int]) -> float:
    """Least nanoseconds for one of what a run says that it did."""
    run()
    taken = []
    for _ in range(closed_loop.ROUNDS):
        start = time.process_time()
        count = run()
        taken.append(1e9 * (time.process_time() - start) / count)
    return min(taken)


def main() -> None:
    """Print operations, times and shares."""
    study = simbias.load(["tracking=none"])
    none, sparse, exact = ZeroBias(6), closed_loop.fitted("sparse_gp", 200), closed_loop.fitted("gp", 571)
    single = 1.0 / best(peak)  # operations per ns
    bare = operations(study, noisy=False)
    rows = [
        ("no bias", bare, (none, False, False, 8, 2000), single / 2),
        ("no bias, noise", operations(study, noisy=True), (none, True, False, 8, 2000), single / 2),
        ("sparse_gp, 200 points", bare + operations_of_gp(200, 200), (sparse, False, False, 8, 200), single),
        ("gp, 571 samples", bare + operations_of_gp(571, 571), (exact, False, False, 8, 200), single),
    ]
    print(f"Peak: {single:.0f} Gflop/s in single precision, half of it in double.\n")
    print("| step of a rollout | operations | ns | Gflop/s | of the peak |\n| :-- | --: | --: | --: | --: |")
    for name, count, arguments, limit in rows:
        taken = best(closed_loop.way(*arguments))
        print(f"| {name} | {count} | {taken:.3g} | {count / taken:.0f} | {count / taken / limit:.0%} |")


if __name__ == "__main__":
    set_num_threads(1)
    with threadpool_limits(1):
        main()
