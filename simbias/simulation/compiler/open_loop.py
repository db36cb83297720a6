"""Predictions of recorded experiments, compiled for each composition of kernels."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from simbias.simulation.compiler.kernels import LANES
from simbias.simulation.compiler.loop import Function, Loop, tuple_of

# Pass b is model b // r on experiment b % r of r experiments, which are concatenated in states (F, n) and
# inputs (F, m). Their windows begin at `firsts`, `leads` frames after the experiments begin.
ARGUMENTS = """\
window, chunk, nominal_parameters, bias_parameters, offsets,
firsts, leads, frames, first_chunks, states, inputs, means,"""

TAKE = """\
model, experiment[lane] = b // firsts.shape[0], b % firsts.shape[0]
frame[lane] = -leads[experiment[lane]]
for i in range({n}):
    total[i, lane] = 0.0"""

GATHER = f"""\
for lane in range({LANES}):
    if running[lane] == 1:
        row = firsts[experiment[lane]] + frame[lane]
        if frame[lane] % window == 0 or frame[lane] == -leads[experiment[lane]]:
            for i in range({{n}}):
                x[i, lane] = states[row, i] + offsets[number[lane] // firsts.shape[0], i]
        for i in range({{m}}):
            u[i, lane] = inputs[row, i]"""

RECORD = f"""\
for lane in range({LANES}):
    if running[lane] == 1:
        frame[lane] += 1
        if frame[lane] % chunk == 0:
            row = first_chunks[experiment[lane]] + frame[lane] // chunk - 1
            for i in range({{n}}):
                if 0 < frame[lane] <= frames[experiment[lane]]:  # one without frames has no chunk
                    means[number[lane] // firsts.shape[0], row, i] = total[i, lane] / chunk
                total[i, lane] = 0.0
        ending[lane] = 1 if frame[lane] >= frames[experiment[lane]] else 0
        ended += ending[lane]"""


@lru_cache(maxsize=64)
def compile_open_loop(
    step: Function, correct: Function, n: int, m: int, n_model_state: int, acting: tuple[int, ...]
) -> Any:
    """The compiled loop of these kernels, ready to be called."""
    return Loop(
        ARGUMENTS,
        {"step": step, "correct": correct},
        *(n, m, n_model_state),
        rows={"u": m, "total": n},
        integers=("experiment",),
        constants=(),
        take=TAKE.format(n=n),
        gather=GATHER.format(n=n, m=m),
        advance=[f"x_, u_ = {tuple_of('x[{}, lane]', n)}, {tuple_of('u[{}, lane]', m)}"],
        settle=[f"total[{i}, lane] += x_new[{i}]" for i in range(n)],
        judge="",
        record=RECORD.format(n=n),
        release="",
        acting=acting,
    ).compiled()
