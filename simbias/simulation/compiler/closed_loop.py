"""The closed loop of Eq. 7 and 9, compiled for each composition of kernels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.loop import Function, Loop, assign, sum_of, tuple_of

# Policy parameters are (k, r) or, for policies with a lookup table, (k, r + 1 + K c): the seconds between its
# rows, and the rows. Noise is (w (T+1), m+n), scenarios (k,), starts (k, n). Outputs are: states (k, T+1, n)
# and inputs (k, T, m), or neither; the cost's final_totals (k, s); frames (k,), and the criterion (k,) that
# each rollout violated, -1 at the horizon.
ARGUMENTS = """\
horizon, time_step, limits, measure_parameters, policy_constants, policy_parameters,
nominal_parameters, bias_parameters, cost_parameters, noise, scenarios, starts,
states, inputs, final_totals, frames, violated,"""

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
    totals[i, lane] = 0.0"""

GATHER = f"""\
for lane in range({LANES}):
    row = first_noise[lane] + frame[lane]
    for i in range({{m}} + {{n}}):
        disturbance[i, lane] = noise[row, i]"""

LOOK_UP = f"""\
for lane in range({LANES}):
    spacing = policy_parameters[number[lane], {{policy}}]
    position = min(frame[lane] * time_step / spacing, last_row)
    before = min(int64(position), int64(last_row) - 1)
    first, share = {{policy}} + 1 + {{columns}} * before, position - before
    for i in range({{columns}}):
        value = policy_parameters[number[lane], first + i]
        after = policy_parameters[number[lane], first + {{columns}} + i]
        looked_up[i, lane] = value + share * (after - value)"""

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
    final_totals[b, i] = totals_before[i, lane]"""


JUDGE = """\
criterion[lane] = failed
ending[lane] = 1 if stop else 0
frame[lane] += 0 if stop else 1
ended += running[lane] if stop else 0"""


REDUCTIONS = {  # nan is ignored
    "sum": "{0} + ({1} if {1} == {1} else 0.0)",
    "max": "max({0}, {1})",
}


@dataclass(frozen=True)
class LoopKernels:
    """Kernels of a closed loop, and the sizes of their arguments."""

    measure: Function
    control: Function  # its parameters are shared by all policies
    step: Function
    correct: Function
    terms: Function | None  # of a cost; None: nothing is accumulated
    n: int  # states
    m: int  # inputs
    criteria: int
    policy_parameters: int  # number per policy, read one by one
    columns: int  # of a policy's table, looked up by time
    n_policy_state: int
    n_model_state: int
    reductions: tuple[str, ...]  # of the cost's terms
    noisy: bool
    acting: tuple[int, ...] = ()  # entries of the nominal model's state, for its bias
    targets: int = 0  # number of targets, the last of the states


@lru_cache(maxsize=64)
def compile_closed_loop(c: LoopKernels) -> Any:
    """The compiled loop of a composition, ready to be called."""
    sizes = {"n": c.n, "m": c.m, "policy": c.policy_parameters, "n_policy_state": c.n_policy_state}
    sizes |= {"n_cost_terms": len(c.reductions), "columns": c.columns}
    functions = {"measure": c.measure, "control": c.control, "step": c.step, "correct": c.correct}
    constants = [f"limit = {tuple_of('limits[{}]', c.criteria)}", c.measure.read("measure")]
    constants.append(c.control.read("policy", "policy_constants"))
    gather = [GATHER.format(**sizes)] if c.noisy else []
    if c.columns:
        rows = f"(policy_parameters.shape[1] - {c.policy_parameters + 1}) // {c.columns}"
        constants.append(f"last_row = {rows} - 1.0")
        gather.append(LOOK_UP.format(**sizes))
    return Loop(
        ARGUMENTS,
        functions | ({"terms": c.terms} if c.terms else {}),
        *(c.n, c.m, c.n_model_state),
        rows={
            "command": c.m,
            "disturbance": c.m + c.n if c.noisy else 0,
            "policy": c.policy_parameters,
            "policy_state": c.n_policy_state,
            **({"looked_up": c.columns} if c.columns else {}),
            "totals": len(c.reductions),
            "totals_before": len(c.reductions),
        },
        integers=("criterion", "first_noise"),
        constants=[*constants, *([c.terms.read("cost")] if c.terms else [])],
        take=TAKE.format(**sizes),
        gather="\n".join(gather),
        advance=_advanced(c),
        settle=_settled(c),
        judge=JUDGE,
        record=RECORD.format(**sizes),
        release=RELEASE.format(**sizes),
        targets=c.targets,
        acting=c.acting,
    ).compiled()


def _advanced(c: LoopKernels) -> list[str]:
    """Lines from the state to the acting input; a rollout that has ended is not stepped further."""
    total = sum_of([f"x_[{i}]" for i in range(c.n)])
    judge = [f"failed = -1 if abs({total}) < inf else {c.criteria}"]  # criteria need not read all states
    judge += [f"failed = failed if measures[{i}] <= limit[{i}] else {i}" for i in reversed(range(c.criteria))]
    seen, force = "x_", "u"
    if c.noisy:
        seen = tuple_of("x_[{0}] + disturbance[{1}, lane]", c.n, c.m)
        force = tuple_of("u[{0}] + disturbance[{0}, lane]", c.m)
    policy = tuple_of("policy[{}, lane]", c.policy_parameters)
    state = tuple_of("policy_state[{}, lane]", c.n_policy_state)
    given = f"{policy}, {seen}, frame[lane] * time_step, {state}, policy_data"
    given += f", {tuple_of('looked_up[{}, lane]', c.columns)}" * bool(c.columns)
    return [
        f"x_ = {tuple_of('x[{}, lane]', c.n)}",
        "measures = measure(x_, measure_data)",
        *judge,
        "stop = (failed >= 0) | (frame[lane] >= horizon)",
        f"u, policy_state_next = control({given})",
        *assign("policy_state", "policy_state_next", c.n_policy_state),
        f"u_ = {force}",
        *assign("command", "u", c.m),
    ]


def _settled(c: LoopKernels) -> list[str]:
    """Lines that accumulate the cost's terms; a rollout that ends here keeps the totals before."""
    if not c.terms:
        return []
    s, command = len(c.reductions), tuple_of("command[{}, lane]", c.m)
    frame = "frame[lane]" if c.correct.takes_all_lanes else "(frame[lane] + 1)"  # of the next state
    return [
        f"terms_ = terms(x_new, {command}, {frame} * time_step, cost_data)",
        f"sums = {tuple_of('totals[{}, lane]', s)}",
        *assign("totals_before", "sums", s),
        *(
            f"totals[{i}, lane] = {REDUCTIONS[reduction].format(f'sums[{i}]', f'terms_[{i}]')}"
            for i, reduction in enumerate(c.reductions)
        ),
    ]
