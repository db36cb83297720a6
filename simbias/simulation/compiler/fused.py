"""The closed loop of Eq. 7 and 9 as one compiled function for each composition of kernels.

Its source is written here: loops over the components of a vector are written out, and one loop over the lanes
of vector registers holds everything, so that LLVM keeps in registers what it computes. Always LANES rollouts
run in step; one that ends makes room for the next, and a lane without one computes what nobody reads. So
there is one path through the code, and the numbers of a rollout depend on nothing beside it.

All lanes are in one array, integers too: of two arrays, LLVM would have to ask whether they overlap. Beyond
about a hundred rows it does not ask, and compiles one rollout after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from simbias.simulation.compiler.compilation import OPTIONS, Compilation
from simbias.simulation.compiler.correction import for_all_lanes
from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.loop_template import CORRECT_ALL_LANES, FORGET, GATHER, TEMPLATE
from simbias.simulation.compiler.text import assign, indent, tuple_of

# Where the rollout of each lane stands.
INTEGERS = ("stopping", "criterion", "running", "frame", "rollout", "first_row")
REDUCTIONS = {"sum": "{} + {}", "max": "max({}, {})"}  # of which the latter leaves out what is no number


@dataclass(frozen=True)
class Composition:
    """Kernels that close a loop, the sizes of what they take, and what is to become of the rollouts."""

    measure: Callable
    control: Callable
    step: Callable
    correct: Callable
    terms: Callable | None  # of a cost; without them, nothing is summed up
    states: int  # n
    inputs: int  # m
    criteria: int  # c
    reductions: tuple[str, ...]  # of the cost's terms
    memory: int  # s of the policy
    hidden: int  # s of the nominal model
    measure_parameters: int
    policy_constants: int
    policy_parameters: int
    nominal_parameters: int
    bias_parameters: int
    cost_parameters: int
    noisy: bool

    @property
    def corrects_all_lanes(self) -> bool:
        """Whether the bias is a kernel for all lanes."""
        return for_all_lanes(self.correct)


def source(c: Composition) -> str:
    """The text of a composition's loop."""
    n, m = c.states, c.inputs
    sizes = {"n": n, "m": m, "LANES": LANES}
    settle = _settled(c)
    corrected = (
        assign("x_next", "y", n) if c.corrects_all_lanes else ["d = correct(x_, u_, bias_data)", *settle]
    )
    after = CORRECT_ALL_LANES.format(**sizes, settle=indent(settle, 12)) if c.corrects_all_lanes else ""
    constants = (
        [] if c.corrects_all_lanes else [f"bias_data = {tuple_of('bias_parameters[{}]', c.bias_parameters)}"]
    )
    if c.terms:
        constants.append(f"cost_data = {tuple_of('cost_parameters[{}]', c.cost_parameters)}")
    if c.noisy:
        seen = tuple_of("x_[{0}] + disturbance[{1}, lane]", n, m)
        force = tuple_of("u[{0}] + disturbance[{0}, lane]", m)
    else:
        seen, force = "x_", "u"
    judge = [f"failed = failed if measures[{i}] <= limit[{i}] else {i}" for i in reversed(range(c.criteria))]
    return TEMPLATE.format(
        **sizes,
        policy=c.policy_parameters,
        nominal=c.nominal_parameters,
        totals=len(c.reductions),
        memory=c.memory,
        rows=indent(_rows(c), 4),
        integers=", ".join(INTEGERS),
        rows_of_integers=", ".join(f"integers[{i}]" for i in range(len(INTEGERS))),
        limits=tuple_of("limits[{}]", c.criteria),
        measure_data=tuple_of("measure_parameters[{}]", c.measure_parameters),
        policy_data=tuple_of("policy_constants[{}]", c.policy_constants),
        constants=indent(constants, 4),
        gather=GATHER.format(**sizes) if c.noisy else "",
        x=tuple_of("x[{}, lane]", n),
        judge=indent(judge, 12),
        control=indent(_controlled(c, seen), 12),
        force=force,
        forget=FORGET.format(hidden=c.hidden) if c.hidden else "",
        advance=indent(_advanced(c), 12),
        correct=indent([*corrected, *assign("command", "u", m), *assign("force", "u_", m)], 12),
        correct_all=after,
    )


def _sizes(c: Composition) -> dict[str, int]:
    """How many rows of the lanes each thing takes; the integers are the last."""
    sizes = {
        "x": c.states,
        "x_next": c.states,
        "correction": c.states,
        "command": c.inputs,
        "force": c.inputs,
        "disturbance": c.inputs + c.states,
        "policy": c.policy_parameters,
        "nominal": c.nominal_parameters,
        "totals": len(c.reductions),
        "before": len(c.reductions),
        "memory": c.memory,
        "hidden": c.hidden,
        "integers": len(INTEGERS),
    }
    return {name: size for name, size in sizes.items() if name != "hidden" or size}


def rows(c: Composition) -> int:
    """How many rows the lanes have."""
    return sum(_sizes(c).values())


def _rows(c: Composition) -> list[str]:
    """Rows for everything in one array of lanes."""
    sizes = _sizes(c)
    ends = np.cumsum(list(sizes.values())).tolist()
    slices = [
        f"{name} = lanes[{end - size}:{end}]" for (name, size), end in zip(sizes.items(), ends, strict=True)
    ]
    return [f"lanes = zeros(({ends[-1]}, {LANES}))", *slices, "integers = integers.view(int64)"]


def _controlled(c: Composition, seen: str) -> list[str]:
    """What the policy commands."""
    parameters, memory = (
        tuple_of("policy[{}, lane]", c.policy_parameters),
        tuple_of("memory[{}, lane]", c.memory),
    )
    return [
        f"u, kept = control({parameters}, {seen}, frame[lane] * time_step, {memory}, policy_data)",
        *assign("memory", "kept", c.memory),
    ]


def _advanced(c: Composition) -> list[str]:
    """What the nominal model makes of it."""
    parameters = tuple_of("nominal[{}, lane]", c.nominal_parameters)
    if not c.hidden:
        return [f"y = step(x_, u_, {parameters})"]
    hidden = tuple_of("hidden[{}, lane]", c.hidden)
    return [
        f"y, hidden_next = step(x_, u_, {parameters}, {hidden})",
        *assign("hidden", "hidden_next", c.hidden),
    ]


def _settled(c: Composition) -> list[str]:
    """The next state, and what the cost sums up, of rollouts that go on."""
    if c.corrects_all_lanes:
        x_next, command = "x_next[{0}, lane] + correction[{0}, lane]", tuple_of("command[{}, lane]", c.inputs)
    else:
        x_next, command = "y[{0}] + d[{0}]", "u"
    lines = [f"x_new = {tuple_of(x_next, c.states)}", *assign("x", "x_new", c.states)]
    if c.terms:
        frame = "frame[lane]" if c.corrects_all_lanes else "(frame[lane] + 1)"  # of the next state
        lines.append(f"terms_ = terms(x_new, {command}, {frame} * time_step, cost_data)")
        lines.append(f"sums = {tuple_of('totals[{}, lane]', len(c.reductions))}")
        lines += assign("before", "sums", len(c.reductions))  # a rollout that ends here ends with these
        for i, reduction in enumerate(c.reductions):
            lines.append(f"totals[{i}, lane] = {REDUCTIONS[reduction].format(f'sums[{i}]', f'terms_[{i}]')}")
    return lines


@lru_cache(maxsize=64)
def compiled_loop(c: Composition) -> Any:
    """The composition's loop, ready to be called."""
    compilation = Compilation()
    functions = {"measure": c.measure, "control": c.control, "step": c.step}
    functions |= {"terms": c.terms} if c.terms else {}
    names = {name: compilation.compiled(function) for name, function in functions.items()}
    names["correct"] = compilation.compiled(c.correct, inline=not c.corrects_all_lanes)
    module: Any = compilation.module(source(c), **names, zeros=np.zeros, int64=np.int64, nan=np.nan)
    if not hasattr(module, "compiled"):
        module.compiled = njit(**OPTIONS, cache=True)(module.closed_loop)
    return module.compiled
