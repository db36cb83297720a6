"""Kernels of components whose authors wrote none: the arithmetic of their methods, written down.

A method in ordinary vectorised NumPy is called once on symbols (`simbias.simulation.compiler.symbols`). What
comes of it is the text of a kernel, which joins the compiled loop as one that is written by hand. It is used
if it gives the method's own numbers at random states, to AGREEMENT. Else, and where the code needs values,
the closed loop is simulated in NumPy, and a warning names the line that keeps it there.

A component is traced once: what it computes must not change after its first use.
"""

from __future__ import annotations

import sys
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simbias.core import FittedBias, Kernel, Model, Nominal, Policy, Task
from simbias.core.error_origin import is_users
from simbias.core.messages import with_type
from simbias.core.records import Array
from simbias.simulation.compiler.points import ROWS, Points
from simbias.simulation.compiler.symbolic_arrays import row, symbols_in
from simbias.simulation.compiler.symbols import Symbol, Trace, TraceError
from simbias.simulation.compiler.written import Written, columns, needed, written

AGREEMENT = 1e-9  # relative, between a traced kernel and the method


class Part(NamedTuple):
    """A part of a closed loop: its kernel, or why it has none."""

    kernel: Any  # of a policy, a function of thetas; None
    why_not: str = ""


Given = tuple[dict[str, Array], list[int]]  # vectors (ROWS, .) that a method takes; sizes of what it gives


def parts_of(model: Model) -> tuple[Part, Part, Part, Part, Part]:
    """The parts of a closed loop: measures, outputs, policy, nominal model, bias."""
    task, policy, points = model.task, model.policy, Points.of(model.task)
    if policy.kernel is None:  # `act` takes states, and computes the outputs that it needs
        control, output = of_policy(policy, task, points), Part(Kernel(_states, np.empty(0)))
    else:
        control, output = Part(policy.kernel), of_output(task, points)
    return (
        of_measure(task, points),
        output,
        control,
        of_nominal(model.nominal, points),
        of_bias(model.bias, points),
    )


def of_measure(task: Task, points: Points) -> Part:
    """The task's measures."""
    sizes = [len(task.criteria)]
    return _own_or_traced(task.measure_kernel, task, "measure", lambda: ({"x": points.x}, sizes))


def of_output(task: Task, points: Points) -> Part:
    """The task's outputs."""
    sizes = [len(task.outputs)]
    return _own_or_traced(task.output_kernel, task, "output", lambda: ({"x": points.x}, sizes))


def of_nominal(nominal: Nominal, points: Points) -> Part:
    """A step of the nominal model."""
    s = nominal.memory_size

    def given() -> Given:
        vectors, sizes = {"x": points.x, "u": points.u}, [points.x.shape[1]]
        if not s:
            return vectors, sizes
        memory = np.random.default_rng(1).standard_normal((ROWS, s))
        return {**vectors, "memory": memory}, [*sizes, s]

    return _own_or_traced(nominal.kernel, nominal, "advance" if s else "step", given)


def of_bias(bias: FittedBias, points: Points) -> Part:
    """A bias' correction."""

    def given() -> Given:
        return {"x": points.x, "u": points.u}, [points.x.shape[1]]

    return _own_or_traced(bias.kernel, bias, "correction", given)


def _own_or_traced(kernel: Kernel | None, component: Any, method: str, given: Callable[[], Given]) -> Part:
    """The component's own kernel or, traced once, that of a method."""
    if kernel is not None:
        return Part(kernel)
    return _once(component, method, lambda: _traced(component, method, *given()))


def _states(x, parameters):
    """Outputs for a policy that takes states."""
    return x


def _traced(component: Any, method: str, vectors: dict[str, Array], sizes: Sequence[int]) -> Part:
    """The kernel of a method that takes these vectors (k, .) and gives some of these sizes."""

    def trace(subject: Callable) -> Kernel:
        trace = Trace()
        given = [row(trace, name, rows.shape[1]) for name, rows in vectors.items()]
        made = subject(*given)
        results = _vectors(made if len(sizes) > 1 else (made,), sizes, trace)
        names = [name for name in vectors if name != "memory"]
        arguments = ", ".join([*names, "p", *(["memory"] if "memory" in vectors else [])])
        function, numbers = written(trace, results, arguments)
        return Kernel(function, numbers)

    def check(subject: Callable, kernel: Kernel) -> None:
        before = [rows for name, rows in vectors.items() if name != "memory"]
        after = [rows for name, rows in vectors.items() if name == "memory"]
        made = columns(kernel.function, *before, tuple(kernel.parameters), *after)
        _compare(subject, list(vectors.values()), made if len(sizes) > 1 else (made,))

    return _part(component, method, trace, check)


class TracedPolicy:
    """A policy's kernel for any thetas: what depends on them alone is computed once for each."""

    def __init__(self, prepare: Written, control: Written, remembers: bool) -> None:
        self._prepare = prepare
        self._control = control
        self.remembers = remembers  # whether it takes time and memory

    def __call__(self, thetas: Array) -> Kernel:
        """The kernel of thetas (k, p)."""
        prepared = columns(self._prepare.function, thetas, tuple(self._prepare.numbers))
        values = [*prepared, *self._control.numbers]
        own = np.empty((len(thetas), len(values)))
        for index, value in enumerate(values):
            own[:, index] = value
        return Kernel(self._control.function, own)


def of_policy(policy: Policy, task: Task, points: Points) -> Part:
    """The kernel of a policy's `act`, which takes states in the place of outputs."""
    p, n, m, s = policy.n_parameters, len(task.states), len(task.inputs), policy.memory_size

    def trace(subject: Callable) -> TracedPolicy:
        trace = Trace()
        theta, x, time = row(trace, "theta", p), row(trace, "x", n), trace.given("t")
        u, kept = _vectors(subject(theta, x, time, row(trace, "memory", s)), (m, s), trace)
        fixed = _of_thetas_alone(trace, [u, kept])
        known = {symbol.index for symbol in fixed}
        remembers = s > 0 or any(symbol is time for symbol in needed(trace, [u], known))
        results, arguments = ([u, kept], "x, p, t, memory") if remembers else ([u], "x, p")
        return TracedPolicy(
            written(trace, [fixed], "theta, p"), written(trace, results, arguments, fixed), remembers
        )

    def check(subject: Callable, traced: TracedPolicy) -> None:
        rng = np.random.default_rng(2)
        lower, upper = (np.clip(bound, -1e3, 1e3) for bound in policy.bounds)
        thetas, memory = rng.uniform(lower, upper, (ROWS, p)), rng.standard_normal((ROWS, s))
        function, parameters = traced(thetas)
        for t in (0.0, 0.1 * task.horizon * task.time_step, 0.7 * task.horizon * task.time_step):
            made = columns(function, points.x, parameters, *((t, memory) if traced.remembers else ()))
            _compare(
                lambda theta, x, memory, t=t: subject(theta, x, t, memory),
                [thetas, points.x, memory],
                made if traced.remembers else (made, tuple(memory.T)),
            )

    return _once(policy, "act", lambda: _part(policy, "act", trace, check))


def _of_thetas_alone(trace: Trace, results: Sequence[Sequence[Symbol]]) -> list[Symbol]:
    """What is computed of thetas, and used together with what changes in a rollout."""
    changing: set[int] = set()
    for symbol in trace.symbols:
        own = symbol.name == "given" and not symbol.value.startswith("theta[")
        if own or symbol.truth or any(operand.index in changing for operand in symbol.operands):
            changing.add(symbol.index)
    used = [symbol for vector in results for symbol in vector]
    for symbol in needed(trace, results):
        if symbol.index in changing:
            used += symbol.operands
    fixed = {symbol.index for symbol in used if symbol.name != "number"} - changing
    return [trace.symbols[index] for index in sorted(fixed)]


def _vectors(made: Any, sizes: Sequence[int], trace: Trace) -> list[list[Symbol]]:
    """What a method gave for one row, as vectors of these sizes."""
    if len(made) != len(sizes):
        raise TraceError(f"it gives {len(made)} values, not {len(sizes)}")
    vectors = [symbols_in(each, trace) for each in made]
    for vector, size in zip(vectors, sizes, strict=True):
        if vector.shape != (1, size):
            raise TraceError(f"of one row it gives the shape {vector.shape}, not {(1, size)}")
    return [list(vector[0]) for vector in vectors]


def _compare(method: Callable, rows: Sequence[Array], made: Sequence[Sequence[Any]]) -> None:
    """Raise unless the method gives the same vectors, twice, and most of them are numbers."""
    first, again = (method(*(each.copy() for each in rows)) for _ in range(2))
    if len(made) == 1:
        first, again = (first,), (again,)
    for one, other, values in zip(first, again, made, strict=True):
        expected = np.asarray(one, np.float64)
        if not np.array_equal(expected, other, equal_nan=True):
            raise TraceError("it gives other numbers when it is asked again")
        traced = np.empty((ROWS, len(values)))
        for index, column in enumerate(values):
            traced[:, index] = column
        if expected.shape != traced.shape:
            raise TraceError(f"of {ROWS} rows it gives the shape {expected.shape}, not {traced.shape}")
        if not np.isfinite(expected).all(axis=1).sum() >= ROWS // 2:
            raise TraceError("it gives what is no number at most states near the start")
        size = np.max(np.abs(expected), axis=0, initial=0.0, where=np.isfinite(expected))
        if not np.isclose(traced, expected, AGREEMENT, 1e-3 * AGREEMENT * size, equal_nan=True).all():
            raise TraceError("what was written down gives other numbers")


def _part(component: Any, method: str, trace: Callable, check: Callable) -> Part:
    """The kernel of a method, or why there is none."""
    function = getattr(type(component), method)
    code = getattr(function, "__code__", None)
    place = f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else ""
    try:
        for each in _within(component):
            if _knows_foreign_code(type(each)):  # type: ignore[arg-type]  # (mypy: a class has a hash)
                raise TraceError("its module calls code by ctypes or cffi")
        subject = getattr(copy(component), method)  # what it remembers of this is forgotten
        with np.errstate(all="ignore"):
            kernel = trace(subject)
            check(subject, kernel)
    except Exception as error:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if is_users(frame.filename)]
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else place
        refused = next((each for each in (error, error.__cause__) if isinstance(each, TraceError)), None)
        why = str(refused) if refused else with_type(error, 100)
        return Part(None, f"{type(component).__name__}.{method} ({place}: {why})")
    return Part(kernel)


def _within(component: Any) -> Iterator[Any]:
    """A component and those that it holds, as an identified model holds the model."""
    yield component
    for each in vars(component).values():
        if isinstance(each, Task | Nominal | Policy | FittedBias):
            yield from _within(each)


@cache
def _knows_foreign_code(component: type) -> bool:
    """Whether a module of a component's class could hand the memory of an array to a library."""
    modules = (sys.modules.get(each.__module__) for each in component.__mro__)
    return any(_is_foreign(value) for module in modules if module for value in vars(module).values())


def _is_foreign(value: Any) -> bool:
    """Whether a value is one of the libraries that call foreign code, or from there."""
    names = getattr(value, "__name__", ""), getattr(value, "__module__", ""), type(value).__module__
    return any(
        str(name).partition(".")[0] in ("ctypes", "_ctypes", "cffi", "_cffi_backend") for name in names
    )


_FOUND: dict[int, dict[str, Part]] = {}  # by the component's identity, for as long as it lives


def _once(component: Any, method: str, find: Callable[[], Part]) -> Part:
    """What was found of the component's method before, or is found now."""
    key = id(component)
    if key not in _FOUND:
        weakref.finalize(component, _FOUND.pop, key, None).atexit = False
        _FOUND[key] = {}
    if method not in _FOUND[key]:
        _FOUND[key][method] = find()
    return _FOUND[key][method]
