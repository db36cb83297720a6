"""A policy's law as a C header and as a Python function, for control loops without simbias."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from textwrap import indent
from typing import Any

import numpy as np

from simbias.interfaces import Policy, Quantity, Task
from simbias.orders.symbols import UntraceableError, formulas, shared, vector
from simbias.records import Array

C_HEADER = """\
/* {title}
 *
 * Call simbias_control once a frame, every {time_step!r} s.
 *   x: {x}
 *   u: {u}{memory_words}
 */
#ifndef SIMBIAS_CONTROLLER_H
#define SIMBIAS_CONTROLLER_H
#include <math.h>

#define SIMBIAS_TIME_STEP {time_step!r} /* s */

static inline void simbias_control(const double x[{n}], double u[{m}]{memory_argument})
{{
{constants}{body}}}

#endif
"""
PYTHON = '''\
"""{title}

Call control once a frame, every {time_step!r} s.
  x: {x}
  returns u: {u}{memory_words}
"""

import math

import numpy as np

TIME_STEP = {time_step!r}  # s
{constants}

def control(x{memory_argument}):
{body}'''


@dataclass(frozen=True)
class Formulas:
    """A law as assignments: intermediate results, inputs and the memory for the next frame."""

    parameters: tuple[tuple[str, Array], ...]  # named constants
    steps: list[tuple[str, Any]]
    u: list[Any]
    memory: list[Any]
    x_name: str  # "x", or "z" where nobody can say how outputs come from states


def derive(task: Task, policy: Policy, theta: Array) -> Formulas:
    """The formulas of the policy theta (p,).

    Raises
    ------
    UntraceableError
        If the policy has no kernel, or one that is no formula.
    """
    if policy.kernel is None:
        raise UntraceableError(f"{type(policy).__name__} has no kernel")
    kernel = policy.kernel(np.atleast_2d(theta))
    x, numbers = _outputs(task)
    own = np.asarray(kernel.parameters, dtype=np.float64)[0]
    p = vector("P", len(own))
    if policy.memory_size:
        memory = vector("memory", policy.memory_size)
        u, kept = formulas(kernel.function, x.outputs, p, vector("t", 1)[0], memory)
    else:
        u, kept = formulas(kernel.function, x.outputs, p), ()
    steps, rest = shared([*u, *kept], "s")
    m = len(task.inputs)
    constants = tuple((name, value) for name, value in (("P", own), ("D", numbers)) if len(value))
    return Formulas(constants, steps, rest[:m], rest[m:], x.name)


@dataclass(frozen=True)
class _Seen:
    """What a controller is given, and the outputs in terms of it."""

    name: str
    outputs: tuple[Any, ...]


def _outputs(task: Task) -> tuple[_Seen, Array]:
    """The outputs as formulas of the states, and the constants in them; else the outputs themselves."""
    n, q = len(task.states), len(task.outputs)
    x = vector("x", n)
    if task.output_kernel is not None:
        own = np.asarray(task.output_kernel.parameters, dtype=np.float64)
        try:
            return _Seen("x", formulas(task.output_kernel.function, x, vector("D", len(own)))), own
        except UntraceableError:
            pass
    elif n == q and _are_states(task):
        return _Seen("x", x), np.empty(0)
    return _Seen("z", vector("z", q)), np.empty(0)


def _are_states(task: Task) -> bool:
    """Whether the outputs are the states themselves, as far as a few states tell."""
    some = np.random.default_rng(0).standard_normal((8, len(task.states)))
    return np.array_equal(task.output(some), some)


def c_header(task: Task, law: Formulas, title: str) -> str:
    """The law in C99."""
    from sympy import ccode

    lines = [f"const double {name} = {ccode(value)};" for name, value in law.steps]
    lines += [f"const double next{k} = {ccode(value)};" for k, value in enumerate(law.memory)]
    lines += [f"u[{k}] = {ccode(value)};" for k, value in enumerate(law.u)]
    lines += [f"memory[{k}] = next{k};" for k in range(len(law.memory))]
    constants = [
        f"static const double {name}[{len(values)}] = {{{', '.join(map(repr, values.tolist()))}}};\n"
        for name, values in law.parameters
    ]
    argument = f", double t, double memory[{len(law.memory)}]" if law.memory else ""
    text = C_HEADER.format(
        **_words(task, law, title), memory_argument=argument,
        constants=indent("".join(constants), "    "), body=indent("\n".join(lines) + "\n", "    "),
    )  # fmt: skip
    return text.replace("double t,", "const double t[1],")


def python_module(task: Task, law: Formulas, title: str) -> str:
    """The law in Python."""
    from sympy import pycode

    lines = [f"{name} = {pycode(value)}" for name, value in law.steps]
    u = f"np.array([{', '.join(map(pycode, law.u))}])"
    kept = f", np.array([{', '.join(map(pycode, law.memory))}])" if law.memory else ""
    lines.append(f"return {u}{kept}")
    constants = [f"{name} = {values.tolist()!r}\n" for name, values in law.parameters]
    return PYTHON.format(
        **_words(task, law, title), memory_argument=", t, memory" if law.memory else "",
        constants="".join(constants), body=indent("\n".join(lines) + "\n", "    "),
    )  # fmt: skip


def _words(task: Task, law: Formulas, title: str) -> dict[str, Any]:
    """What both languages say."""
    seen = task.states if law.x_name == "x" else task.outputs
    size = len(law.memory)
    memory = (
        f"\n  t: [time in s since the start]; memory: {size} numbers, zero at the start, for the next frame"
        if size
        else ""
    )
    return {
        "title": title,
        "time_step": task.time_step,
        "x": _named(seen),
        "u": _named(task.inputs),
        "n": len(seen),
        "m": len(task.inputs),
        "memory_words": memory,
    }


def _named(quantities: Sequence[Quantity]) -> str:
    """Names and units, in order."""
    return ", ".join(f"{quantity.name} ({quantity.unit})" for quantity in quantities)
