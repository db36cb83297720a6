"""Comparison of generated controllers with the policy, frame by frame, before they are written."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from simbias.core import Policy, Task
from simbias.core.messages import brief
from simbias.core.records import Array
from simbias.lab.safety import Bounds, SafetyLimitedPolicy, UnsafeError, without_limits

FRAMES = 200  # of each sequence of states
AMPLITUDES = (0.0, 0.01, 0.1, 1.0, 10.0)  # of the sequences, in addition to the deviation of starts
AFTER = 50  # frames after the horizon that are also compared
STEPS = np.geomspace(0.01, 10.0, 50)  # of wandering states: the smallest at which no input saturates
AGREEMENT = 1e-9  # relative to the largest input
ROUNDING = 2.0**-52  # relative, of measurements; its effect grows if a policy state is chaotic,
ROUNDED = 1e3  # and this many times the effect is tolerated,
CHECKED, MOST_UNCHECKED = 1e-6, 0.3  # if it is less than this in most frames, relative to the largest input
SECONDS = 60.0  # for a C compiler

MAIN = """\
#include <stdio.h>
#include "controller.h"

int main(void)
{{
    double x[{n}], u[{m}];
    simbias_controller controller;
    int aborted, aborts = 2;
    for (;;) {{
        for (int i = 0; i < {n}; ++i)
            if (scanf("%lf", &x[i]) != 1)
                return 0;
        if (aborts == 2) {{
            simbias_start(&controller);
            aborts = 0;
        }}
        aborted = simbias_control(&controller, x, u);
        aborts += aborted;
        printf("%d", aborted);
        for (int i = 0; i < {m}; ++i)
            printf(" %.17g", u[i]);
        printf("\\n");
    }}
}}
"""


def difference(
    policy: Policy, task: Task, theta: Array, bounds: Bounds, header: str, module: str, whole: bool = False
) -> str:
    """Difference of the controllers in C and Python from the policy theta (p,), in a line; "" if none.

    C is tested if there is a compiler, `cc`. Effects of rounding alone are no difference. With `whole`, the
    horizon and some frames after it are compared, and no limit in `bounds` may end them; otherwise the first
    frames.
    """
    limited = SafetyLimitedPolicy(without_limits(policy), task, bounds)
    sequences = [_wandering(policy, task, theta)] if whole else _sequences(task)
    start = partial(limited.controller, theta, task.time_step)
    expected = [_run(start, states, task) for states in sequences]
    names: dict[str, Any] = {}
    exec(compile(module, "<controller.py>", "exec"), names)
    made = {"Python": [_run(names["Controller"], states, task) for states in sequences]}
    compiler = shutil.which("cc")
    if compiler:
        try:
            made["C"] = _in_c(compiler, header, task, sequences)
        except subprocess.SubprocessError as error:
            return f"{compiler} does not compile or run it ({brief(str(getattr(error, 'stderr', error)))})"
    size = max(1e-300, *(np.abs(rows[:, 1:]).max(initial=0.0) for rows in expected))
    rounded = [_run(start, states * (1.0 + ROUNDING), task) for states in sequences]  # zeros stay zeros
    changes = [np.abs(a - b).max(axis=1, keepdims=True) for a, b in zip(rounded, expected, strict=True)]
    allowed = [AGREEMENT * size + ROUNDED * np.maximum.accumulate(each) for each in changes]
    if np.mean(np.concatenate(allowed) > CHECKED * size) > MOST_UNCHECKED:  # too little would be compared
        allowed = [np.full_like(each, AGREEMENT * size) for each in changes]
    for language, all_rows in made.items():
        for rows, right, tolerance in zip(all_rows, expected, allowed, strict=True):
            off = ~np.isclose(rows, right, AGREEMENT, tolerance).all(axis=1)
            if off.any():
                frame = int(np.argmax(off))
                return (
                    f"in {language}, frame {frame} gives abort, u = {rows[frame].tolist()} where the policy "
                    f"gives {right[frame].tolist()}"
                )
    return ""


def _sequences(task: Task) -> list[Array]:
    """States (FRAMES + 2, n) that grow from the start on, drift and jump; the last but one is nan."""
    rng, n = np.random.default_rng(0), len(task.states)
    growing = np.linspace(0.0, 1.0, FRAMES)[:, None]
    sequences = []
    for amplitude in AMPLITUDES:
        drift = np.sin(2 * np.pi * growing * rng.uniform(0.5, 5.0, n) + rng.uniform(0.0, 6.3, n))
        around = (task.start_deviation + amplitude) * (drift + 0.1 * rng.standard_normal((FRAMES, n)))
        states = task.start_mean + growing * around
        sequences.append(np.concatenate([states, np.full((1, n), np.nan), task.start_mean[None]]))
    return sequences


def _wandering(policy: Policy, task: Task, theta: Array) -> Array:
    """States (k, n) that wander over the horizon and beyond, so that inputs rarely saturate."""
    rng, x, policy_state = np.random.default_rng(0), task.start_mean, np.zeros(policy.state_size)
    lower, upper = task.input_bounds
    states = np.empty((task.horizon + AFTER, len(x)))
    for frame in range(len(states)):
        for step in STEPS:
            states[frame] = x + step * rng.standard_normal(len(x))
            with np.errstate(all="ignore"):
                u, kept = policy.act(theta, states[frame].copy(), frame * task.time_step, policy_state)
            if ((lower < u) & (u < upper)).all():
                break
        x, policy_state = states[frame], kept
    return states


def _run(start: Callable[[], Any], states: Array, task: Task) -> Array:
    """Abort flag and inputs (k, 1 + m) of each frame, at states (k, n).

    An abort also holds for the next frame. Then a new controller takes over, so that all frames count.
    """
    rows, aborts = np.zeros((len(states), 1 + len(task.inputs))), 2
    with np.errstate(all="ignore"):
        for row, x in zip(rows, states, strict=True):
            if aborts == 2:
                controller, aborts = start(), 0
            try:
                row[1:] = controller(x)
            except (UnsafeError, ValueError):
                row[0] = 1.0
                aborts += 1
    return rows


def _in_c(compiler: str, header: str, task: Task, sequences: Sequence[Array]) -> list[Array]:
    """Abort flags and inputs (k, 1 + m) of each sequence of states (k, n), by the compiled C controller."""
    n, m = len(task.states), len(task.inputs)
    with TemporaryDirectory(prefix="simbias-") as folder:
        program = Path(folder, "main")
        Path(folder, "controller.h").write_text(header, encoding="utf-8")
        Path(folder, "main.c").write_text(MAIN.format(n=n, m=m))
        command = [compiler, "-std=c99", "-O1", "-o", str(program), str(Path(folder, "main.c")), "-lm"]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=SECONDS)
        rows = []
        for states in sequences:
            text = "\n".join(" ".join(map(repr, row)) for row in states.tolist())
            done = subprocess.run(
                [program], input=text, check=True, capture_output=True, text=True, timeout=SECONDS
            )
            rows.append(np.array([line.split() for line in done.stdout.splitlines()], np.float64))
    return rows
