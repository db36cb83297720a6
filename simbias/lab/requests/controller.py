"""A policy's law as a C header and as a Python function, for control loops without simbias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import indent
from typing import Any

import numpy as np

from simbias.core import Policy, Quantity, Task
from simbias.core.records import Array
from simbias.lab.requests.symbols import UntraceableError, formulas, scalar, shared, vector
from simbias.lab.safety import Bounds

C_HEADER = """\
/* {title}
 *
 * Call simbias_control once a frame, every {time_step!r} s.
 *   {seen}: {seen_words}
 *   u: {u_words}{memory_words}
 * It returns 0, or 1 if a limit is exceeded or something is no number: then u is zero, and the experiment has
 * to be aborted.
 */
#ifndef SIMBIAS_CONTROLLER_H
#define SIMBIAS_CONTROLLER_H
#include <math.h>

#define SIMBIAS_TIME_STEP {time_step!r} /* s */

static inline int simbias_control(const double {seen}[{n}], double u[{m}]{memory_argument})
{{
{constants}{body}    int safe = 1;
    for (int i = 0; i < {n}; ++i)
        safe = safe && fabs({seen}[i]) <= SEEN_LIMIT[i];
    for (int i = 0; i < {m}; ++i)
        safe = safe && fabs(u[i]) <= INPUT_LIMIT[i];
    for (int i = 0; i < {m}; ++i)
        u[i] = safe ? u[i] : 0.0;
    return !safe;
}}

#endif
"""
PYTHON = '''\
"""{title}

Call control once a frame, every {time_step!r} s.
  {seen}: {seen_words}
  returns u: {u_words}{memory_words}
It raises ValueError if a limit is exceeded or something is no number: abort the experiment then.
"""

import math

import numpy as np

TIME_STEP = {time_step!r}  # s
{constants}

def control({seen}{memory_argument}):
{body}    if not (np.abs({seen}) <= SEEN_LIMIT).all() or not (np.abs(u) <= INPUT_LIMIT).all():
        raise ValueError(f"abort: {seen} = {{{seen}}}, u = {{u}}")
    return u{kept}
'''


@dataclass(frozen=True)
class Formulas:
    """A law as assignments: intermediate results, inputs and the memory for the next frame."""

    parameters: tuple[tuple[str, Array], ...]  # named constants
    steps: list[tuple[str, Any]]
    u: list[Any]
    memory: list[Any]
    seen: str  # what they are formulas of: "x", or "z" where nothing says how outputs come from states


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
    seen, numbers = _outputs(task)
    own = np.asarray(kernel.parameters, dtype=np.float64)[0]
    p = vector("P", len(own))
    if policy.state_size:
        memory = vector("memory", policy.state_size)
        u, kept = formulas(kernel.function, seen.outputs, p, scalar("t"), memory)
    else:
        u, kept = formulas(kernel.function, seen.outputs, p), ()
    steps, rest = shared([*u, *kept], "s")
    m = len(task.inputs)
    constants = tuple((name, value) for name, value in (("P", own), ("D", numbers)) if len(value))
    return Formulas(constants, steps, rest[:m], rest[m:], seen.name)


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


def c_header(task: Task, law: Formulas, title: str, bounds: Bounds) -> str:
    """The law in C99."""
    from sympy import ccode

    lines = [f"const double {name} = {ccode(value)};" for name, value in law.steps]
    lines += [f"const double next{k} = {ccode(value)};" for k, value in enumerate(law.memory)]
    lines += [f"u[{k}] = {ccode(value)};" for k, value in enumerate(law.u)]
    lines += [f"memory[{k}] = next{k};" for k in range(len(law.memory))]
    constants = [
        f"    static const double {name}[{len(values)}] = {{{', '.join(map(repr, values.tolist()))}}};\n"
        for name, values in _constants(task, law, bounds)
    ]
    return C_HEADER.format(
        **_words(task, law, title),
        memory_argument=f", double t, double memory[{len(law.memory)}]" if law.memory else "",
        constants="".join(constants),
        body=indent("\n".join(lines) + "\n", "    "),
    )


def python_module(task: Task, law: Formulas, title: str, bounds: Bounds) -> str:
    """The law in Python."""
    from sympy import pycode

    lines = [f"{name} = {pycode(value)}" for name, value in law.steps]
    lines.append(f"u = np.array([{', '.join(map(pycode, law.u))}])")
    constants = [f"{name} = {values.tolist()!r}\n" for name, values in _constants(task, law, bounds)]
    return PYTHON.format(
        **_words(task, law, title),
        memory_argument=", t, memory" if law.memory else "",
        kept=f", np.array([{', '.join(map(pycode, law.memory))}])" if law.memory else "",
        constants="".join(constants),
        body=indent("\n".join(lines) + "\n", "    "),
    )


def _constants(task: Task, law: Formulas, bounds: Bounds) -> list[tuple[str, Array]]:
    """Named numbers; where there is no limit, it is that of a finite number."""
    largest = np.finfo(np.float64).max
    seen = bounds.states if law.seen == "x" else np.full(len(task.outputs), largest)
    return [
        *law.parameters,
        ("SEEN_LIMIT", np.fmin(seen, largest)),
        ("INPUT_LIMIT", np.fmin(bounds.inputs, largest)),
    ]


def _words(task: Task, law: Formulas, title: str) -> dict[str, Any]:
    """What both languages say."""
    quantities = task.states if law.seen == "x" else task.outputs
    memory = (
        f"\n    t: s since the start; memory: {len(law.memory)} numbers for the next frame, at first 0"
        if law.memory
        else ""
    )
    return {
        "title": title,
        "time_step": task.time_step,
        "seen": law.seen,
        "seen_words": _list(quantities),
        "u_words": _list(task.inputs),
        "n": len(quantities),
        "m": len(task.inputs),
        "memory_words": memory,
    }


def _list(quantities: Sequence[Quantity]) -> str:
    """Names and units, in order."""
    return ", ".join(f"{quantity.name} ({quantity.unit})" for quantity in quantities)
