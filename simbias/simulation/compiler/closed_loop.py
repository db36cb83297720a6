"""The closed loop of Eq. 7 and 9, compiled for each composition of kernels."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.loop import Function, Loop
from simbias.simulation.compiler.text import assign, tuple_of

# Noise is (w (T+1), m+n), scenarios (k,), starts (k, n). Filled are: states (k, T+1, n) and inputs (k, T, m),
# or neither; the cost's final_terms (k, s); frames (k,), and the criterion (k,) that each rollout violated,
# -1 at the horizon.
ARGUMENTS = """\
horizon, time_step, limits, measure_parameters, output_parameters, policy_parameters,
nominal_parameters, bias_parameters, cost_parameters, noise, scenarios, starts,
states, inputs, final_terms, frames, violated,"""

TAKE = """\
model = scenarios[b]
first_noise[lane] = model * (horizon + 1)
for i in range({n}):
    x[i, lane] = starts[b, i]
for i in range({policy}):
    policy[i, lane] = policy_parameters[b, i]
for i in range({n_policy_state}):
    policy_state[i, lane] = 0.0
for i in range({n_cost_terms}):
    terms[i, lane] = 0.0"""

GATHER = f"""\
for lane in range({LANES}):
    row = first_noise[lane] + frame[lane]
    for i in range({{m}} + {{n}}):
        disturbance[i, lane] = noise[row, i]"""

RECORD = f"""\
if states.shape[0] > 0:
    for lane in range({LANES}):
        if running[lane] == 1 and ending[lane] == 0:
            b, t = number[lane], frame[lane]
            for i in range({{m}}):
                inputs[b, t - 1, i] = command[i, lane]
            for i in range({{n}}):
                states[b, t, i] = x[i, lane]"""

RELEASE = """\
frames[b], violated[b] = frame[lane], criterion[lane]
for i in range({n_cost_terms}):
    final_terms[b, i] = terms_before[i, lane]"""


JUDGE = """\
criterion[lane] = failed
ending[lane] = 1 if stop else 0
frame[lane] += 0 if stop else 1
ended += running[lane] if stop else 0"""


@dataclass(frozen=True)
class Composition:
    """Kernels that close a loop, and the sizes of what they take."""

    measure: Function
    output: Function
    control: Function
    step: Function
    correct: Function
    total: Function | None  # of a cost; without one, nothing is summed up
    n: int  # states
    m: int  # inputs
    criteria: int
    n_policy_state: int
    n_model_state: int
    n_cost_terms: int
    noisy: bool


@lru_cache(maxsize=64)
def closed_loop(c: Composition) -> Any:
    """The composition's loop, ready to be called."""
    sizes = {"n": c.n, "m": c.m, "policy": c.control.parameters, "n_policy_state": c.n_policy_state}
    sizes |= {"n_cost_terms": c.n_cost_terms}
    functions = {"measure": c.measure, "output": c.output, "control": c.control}
    functions |= {"step": c.step, "correct": c.correct} | ({"total": c.total} if c.total else {})
    constants = [f"limit = {tuple_of('limits[{}]', c.criteria)}"]
    constants += [c.measure.read("measure"), c.output.read("output")]
    return Loop(
        ARGUMENTS,
        functions,
        *(c.n, c.m, c.n_model_state),
        rows={
            "command": c.m,
            "disturbance": c.m + c.n if c.noisy else 0,
            "policy": c.control.parameters,
            "policy_state": c.n_policy_state,
            "terms": c.n_cost_terms,
            "terms_before": c.n_cost_terms,
        },
        integers=("criterion", "first_noise"),
        constants=[*constants, *([c.total.read("cost")] if c.total else [])],
        take=TAKE.format(**sizes),
        gather=GATHER.format(**sizes) if c.noisy else "",
        advance=_advanced(c),
        settle=_settled(c),
        judge=JUDGE,
        record=RECORD.format(**sizes),
        release=RELEASE.format(**sizes),
    ).compiled()


def _advanced(c: Composition) -> list[str]:
    """From the state to the input that acts; a rollout that ends is not stepped any further."""
    judge = [f"failed = failed if measures[{i}] <= limit[{i}] else {i}" for i in reversed(range(c.criteria))]
    seen, force = "x_", "u"
    if c.noisy:
        seen = tuple_of("x_[{0}] + disturbance[{1}, lane]", c.n, c.m)
        force = tuple_of("u[{0}] + disturbance[{0}, lane]", c.m)
    return [
        f"x_ = {tuple_of('x[{}, lane]', c.n)}",
        "measures = measure(x_, measure_data)",
        "failed = -1",
        *judge,
        "stop = (failed >= 0) | (frame[lane] >= horizon)",
        f"z = output({seen}, output_data)",
        *_controlled(c),
        f"u_ = {force}",
        *assign("command", "u", c.m),
    ]


def _controlled(c: Composition) -> list[str]:
    """The policy's command u; if that takes more than outputs, also of time and policy state."""
    parameters = c.control.own("policy")
    if len(inspect.signature(c.control.function).parameters) == len(("z", "parameters")):
        return [f"u = control(z, {parameters})"]
    state = tuple_of("policy_state[{}, lane]", c.n_policy_state)
    return [
        f"u, policy_state_next = control(z, {parameters}, frame[lane] * time_step, {state})",
        *assign("policy_state", "policy_state_next", c.n_policy_state),
    ]


def _settled(c: Composition) -> list[str]:
    """The cost sums up; a rollout that ends here ends with the sums before."""
    if not c.total:
        return []
    return [
        f"sums = {tuple_of('terms[{}, lane]', c.n_cost_terms)}",
        *assign("terms_before", "sums", c.n_cost_terms),
        f"after = total(x_new, {tuple_of('command[{}, lane]', c.m)}, cost_data, sums)",
        *assign("terms", "after", c.n_cost_terms),
    ]
