"""Kernels for components without hand-written ones, traced from their methods.

A method in ordinary vectorised NumPy is called once on symbols (`simbias.simulation.compiler.symbols`). The
result is the text of a kernel, which joins the compiled loop like a hand-written one. It is used if it agrees
with the method at random states, to rounding. Otherwise, or if the code needs values, the closed loop is
simulated in NumPy, and a warning names the responsible line.

A component is traced once: its computation must not change after its first use.
"""

from __future__ import annotations

import sys
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from simbias.core import Cost, FittedBias, Kernel, Model, Nominal, Policy, Task
from simbias.core.error_origin import is_users, written_at
from simbias.core.messages import with_type
from simbias.core.records import Array
from simbias.simulation.compiler.agreement import ROWS, Points, compare, compare_frames, points_of, rows
from simbias.simulation.compiler.symbolic_arrays import array, row, symbols_in
from simbias.simulation.compiler.symbols import LOOKED_UP, Symbol, Trace, TraceError
from simbias.simulation.compiler.tables import Lookup, scheduled
from simbias.simulation.compiler.written import Formulas, columns, needed, written


class KernelOrReason(NamedTuple):
    """The kernel of a part of a closed loop, or why it has none."""

    kernel: Any  # a `PolicyKernel` for a policy; None if there is none
    why_not: str = ""
    kept: Sequence[Any] = ()  # objects whose addresses the kernel holds


def parts_of(model: Model) -> tuple[KernelOrReason, KernelOrReason, KernelOrReason, KernelOrReason]:
    """The parts of a closed loop: measures, policy, nominal model, bias."""
    task = model.task
    points, of_robot = (partial(points_of, each) for each in (task, task.without_targets))
    return (
        of_measure(task, points),
        of_policy(model.policy, task, points),
        of_nominal(model.nominal, of_robot),
        of_bias(model.bias, of_robot),
    )


def of_measure(task: Task, points: Points) -> KernelOrReason:
    """The kernel of the task's measures."""
    return _once(task, "measure", lambda: _traced(task, "measure", {"x": points()[0]}, [len(task.criteria)]))


def of_cost(cost: Cost, task: Task) -> KernelOrReason:
    """The kernel of a cost's terms, if it has terms and depends only on their totals."""
    if not cost.reductions or type(cost).of is not Cost.of:
        return KernelOrReason(None, f"{type(cost).__name__} declares no `reductions`, or has its own `of`")

    def find() -> KernelOrReason:
        (x, u), t = points_of(task), task.time_step * np.arange(1.0, ROWS + 1)
        return _traced(cost, "terms", {"x": x, "u": u, "t": t}, [len(cost.reductions)])

    return _once(cost, "terms", find)


def of_nominal(nominal: Nominal, points: Points) -> KernelOrReason:
    """The kernel of the nominal model's step."""
    if nominal.kernel is not None:
        return KernelOrReason(nominal.kernel)
    s = nominal.state_size
    method = "advance" if s else "step"

    def find() -> KernelOrReason:
        x, u = points()
        vectors, sizes = {"x": x, "u": u}, [x.shape[1]]
        if s:
            vectors["model_state"] = np.random.default_rng(1).standard_normal((ROWS, s))
            sizes.append(s)
        return _traced(nominal, method, vectors, sizes)

    return _once(nominal, method, find)


def of_bias(bias: FittedBias, points: Points) -> KernelOrReason:
    """The kernel of a bias' correction."""
    if bias.kernel is not None:
        return KernelOrReason(bias.kernel)

    def find() -> KernelOrReason:
        x, u = points()
        return _traced(bias, "correction", {"x": x, "u": u}, [x.shape[1]])

    return _once(bias, "correction", find)


def _traced(component: Any, method: str, vectors: dict[str, Array], sizes: Sequence[int]) -> KernelOrReason:
    """The kernel of a method that takes these vectors (k, .) and returns vectors of these sizes."""
    arguments = list(vectors)  # of the kernel, whose parameters come before a model state
    arguments.insert(len(vectors) - ("model_state" in vectors), "p")

    def write(trace: Trace, subject: Callable) -> Kernel:
        given = [
            row(trace, name, each.shape[1]) if each.ndim > 1 else array([trace.given(name)])
            for name, each in vectors.items()
        ]
        made = subject(*given)
        results = _vectors(made if len(sizes) > 1 else (made,), sizes, trace)
        _refuse_calls(trace)  # models are many; to trace each takes longer than to predict in NumPy
        return written(trace, results, ", ".join(arguments))

    def check(subject: Callable, kernel: Kernel) -> None:
        given = {**vectors, "p": tuple(kernel.parameters)}
        made = columns(kernel.function, *(given[name] for name in arguments))
        compare(subject, list(vectors.values()), made if len(sizes) > 1 else (made,))

    return _part(component, method, write, check)


class PolicyKernel(NamedTuple):
    """A policy's `act` for any thetas; parts that depend only on theta are computed once."""

    function: Callable  # (parameters, x, t, policy_state, constants) -> u, policy_state; a table row is last
    constants: Array  # (c,) numbers shared by all thetas
    prepare: Kernel  # from thetas to parameters
    size: int  # r, number of parameters read one by one
    columns: int = 0  # c, of the table after them, looked up by time

    def parameters(self, thetas: Array) -> Array:
        """Parameters (k, r) of the kernel for thetas (k, p); with a table, (k, r + 1 + K c)."""
        return rows(columns(self.prepare.function, thetas, tuple(self.prepare.parameters)), len(thetas))

    def looked_up(self, parameters: Array, t: float) -> tuple[Array, ...]:
        """The rows (k, c) of the tables at time t: the last argument of the function, if it has one."""
        if not self.columns:
            return ()
        spacing, entries = parameters[0, self.size], parameters[:, self.size + 1 :]
        return (scheduled(entries.reshape(len(parameters), -1, self.columns), t, spacing),)


def of_policy(policy: Policy, task: Task, points: Points) -> KernelOrReason:
    """The kernel of a policy's `act`."""
    p, s = policy.n_parameters, policy.state_size

    def write(trace: Trace, subject: Callable) -> PolicyKernel:
        _, u, kept = _formulas(trace, subject, policy, task, row(trace, "theta", p))
        fixed, lookup = _of_thetas_alone(trace, [u, kept]), Lookup.among(needed(trace, [u, kept]))
        arguments = "p, x, t, policy_state, c" + ", row" * bool(lookup.columns)
        return PolicyKernel(
            *written(trace, [u, kept], arguments, fixed, "c", lookup.columns),
            written(trace, [[*fixed, *lookup.table]], "theta, p", compiled=False),
            *(len(fixed), len(lookup.columns)),
        )

    def check(subject: Callable, traced: PolicyKernel) -> None:
        rng, (near, _) = np.random.default_rng(2), points()
        lower, upper = (np.clip(bound, -1e3, 1e3) for bound in policy.bounds)
        thetas, state = rng.uniform(lower, upper, (ROWS, p)), rng.standard_normal((ROWS, s))
        parameters, constants = traced.parameters(thetas), tuple(traced.constants)

        def made(x: Array, t: float, state: Array) -> tuple[Any, ...]:
            row = traced.looked_up(parameters, t)
            return columns(traced.function, parameters, x, t, state, constants, *row)

        for share in (0.0, 0.1, 0.7):
            t = share * task.horizon * task.time_step
            compare(
                lambda theta, x, state, t=t: subject(theta, x, t, state),
                [thetas, near, state],
                made(near, t, state),
            )
        if s and traced.function not in _COMPARED:  # realistic states, not random numbers
            compare_frames(lambda x, t, state: subject(thetas, x, t, state), made, near, s)
        _COMPARED.add(traced.function)

    return _once(policy, "act", lambda: _part(policy, "act", write, check))


_COMPARED: set[Callable] = set()  # policies that differ in numbers only have the same function


def formulas_of(policy: Policy, task: Task, theta: Array, method: str = "act") -> Formulas | str:
    """Formulas of the policy theta (p,) in a frame, or the reason why they cannot be written down."""

    def write(trace: Trace, subject: Callable) -> Formulas:
        formulas = _formulas(trace, subject, policy, task, theta[None])
        _refuse_calls(trace)
        return formulas

    part = _part(policy, method, write, lambda subject, formulas: None)
    return part.kernel or part.why_not


def _formulas(trace: Trace, act: Callable, policy: Policy, task: Task, theta: Array) -> Formulas:
    """Formulas of a policy's `act` at theta (1, p)."""
    x, state = row(trace, "x", len(task.states)), row(trace, "policy_state", policy.state_size)
    made = act(theta, x, trace.given("t"), state)
    return Formulas(trace, *_vectors(made, (len(task.inputs), policy.state_size), trace))


def _of_thetas_alone(trace: Trace, results: Sequence[Sequence[Symbol]]) -> list[Symbol]:
    """Symbols that depend only on thetas and are used with symbols that change in a rollout."""
    changing: set[int] = set()
    for symbol in trace.symbols:
        own = symbol.name == "given" and not symbol.value.startswith("theta[")
        if own or symbol.truth or any(operand.index in changing for operand in symbol.operands):
            changing.add(symbol.index)
    used = [symbol for vector in results for symbol in vector]
    for symbol in needed(trace, results):
        if symbol.index in changing and symbol.name != LOOKED_UP:
            used += symbol.operands
    fixed = {symbol.index for symbol in used if symbol.name != "number"} - changing
    return [trace.symbols[index] for index in sorted(fixed)]


def _vectors(made: Any, sizes: Sequence[int], trace: Trace) -> list[list[Symbol]]:
    """The results of a method for one row, as vectors of these sizes."""
    if len(made) != len(sizes):
        raise TraceError(f"it gives {len(made)} values, not {len(sizes)}")
    vectors = [symbols_in(each, trace) for each in made]
    for vector, size in zip(vectors, sizes, strict=True):
        if vector.shape != (1, size):
            raise TraceError(f"for one row it gives the shape {vector.shape}, not {(1, size)}")
    return [list(vector[0]) for vector in vectors]


def _refuse_calls(trace: Trace) -> None:
    """Refuse a trace that calls kernels."""
    if trace.functions:
        raise TraceError("it predicts with a model that has no formula, such as MuJoCo's")


def _part(component: Any, method: str, write: Callable, check: Callable) -> KernelOrReason:
    """The kernel of a method, or why there is none."""
    place, trace = written_at(component, method), Trace()
    try:
        for each in _within(component):
            if _knows_foreign_code(type(each)):  # type: ignore[arg-type]  # (mypy: a class has a hash)
                raise TraceError("its module calls code by ctypes or cffi")
        subject = getattr(copy(component), method)  # a copy, so that the trace leaves no memory
        with np.errstate(all="ignore"):
            kernel = write(trace, subject)
            check(subject, kernel)
    except Exception as error:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if is_users(frame.filename)]
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else place
        refused = next((each for each in (error, error.__cause__) if isinstance(each, TraceError)), None)
        why = str(refused) if refused else with_type(error, 100)
        return KernelOrReason(None, f"{type(component).__name__}.{method} ({place}: {why})")
    return KernelOrReason(kernel, kept=trace.kept)


def _within(component: Any) -> Iterator[Any]:
    """A component and the components it contains, such as the model in an identified model."""
    yield component
    for each in vars(component).values():
        if isinstance(each, Task | Nominal | Policy | FittedBias):
            yield from _within(each)


@cache
def _knows_foreign_code(component: type) -> bool:
    """Whether a module of a component's class could pass the memory of an array to a library."""
    modules = (sys.modules.get(each.__module__) for each in component.__mro__)
    return any(_is_foreign(value) for module in modules if module for value in vars(module).values())


def _is_foreign(value: Any) -> bool:
    """Whether a value is, or comes from, a library that calls foreign code."""
    names = getattr(value, "__name__", ""), getattr(value, "__module__", ""), type(value).__module__
    return any(
        str(name).partition(".")[0] in ("ctypes", "_ctypes", "cffi", "_cffi_backend") for name in names
    )


_FOUND: dict[int, dict[str, KernelOrReason]] = {}  # by the component's identity, as long as it exists


def _once(component: Any, method: str, find: Callable[[], KernelOrReason]) -> KernelOrReason:
    """The kernel of a component's method, or the reason why there is none; determined once."""
    key = id(component)
    if key not in _FOUND:
        weakref.finalize(component, _FOUND.pop, key, None).atexit = False
        _FOUND[key] = {}
    if method not in _FOUND[key]:
        _FOUND[key][method] = find()
    return _FOUND[key][method]
