"""Checks of a task before anything runs."""

from __future__ import annotations

import warnings

import numpy as np

from simbias.core.errors import StudyWarning
from simbias.core.quantities import TURNS
from simbias.core.records import Array
from simbias.core.robot import Task

DRAWN, MANY = 100, 0.1  # starts, and the share of failing ones that is reported


def check_quantities(task: Task) -> None:
    """Raise ValueError if two columns of a recording have one name, or an angle's unit is unknown."""
    names = ["time", *(each.name for each in (*task.states, *task.inputs)), "failure"]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise ValueError(f"{twice[0]}: two of time, states, targets, inputs and failure have this name")
    for each in (*task.states, *task.goals):
        if each.wraps and each.unit not in TURNS:
            units = ", ".join(TURNS)
            raise ValueError(f"{each.name} wraps: expected an angle in {units}, got the unit {each.unit}")


def check_starts(task: Task) -> None:
    """Refuse a task if all drawn starts fail, or an output is not finite at any; warn if many do."""
    starts = drawn_starts(task, np.random.default_rng(0))
    failed = task.violated(starts) >= 0
    with np.errstate(all="ignore"):
        outputs = np.asarray(task.output(starts[~failed]))
    if outputs.shape != (expected := (int(np.sum(~failed)), len(task.outputs))):
        raise ValueError(f"output of {expected[0]} states: expected shape {expected}, got {outputs.shape}")
    wrong = ~np.isfinite(outputs).T
    names = dict.fromkeys(task.failure(start) or "" for start in starts[failed])
    found = [(failed, f"the task fails at {{}} drawn starts: {', '.join(names)}")]
    found += [
        (each, f"output {output.name} is not finite at {{}} drawn starts that do not fail")
        for output, each in zip(task.outputs, wrong, strict=True)
    ]
    for where, words in found:
        if len(where) and where.all():
            raise ValueError(words.format(f"all {len(where)}"))
        if where.sum() > MANY * len(where):
            warnings.warn(words.format(f"{where.sum()} of {len(where)}"), StudyWarning, stacklevel=2)


def drawn_starts(task: Task, rng: np.random.Generator) -> Array:
    """Starts (k, n) drawn by a task."""
    return np.array([task.draw_start(rng) for _ in range(DRAWN)])


def varied_states(task: Task) -> Array:
    """States (k, n) of all magnitudes around drawn starts, the same at each call."""
    rng = np.random.default_rng(0)
    starts = drawn_starts(task, rng)
    return starts + rng.choice([-1.0, 0.0, 1.0], starts.shape) * 10.0 ** rng.uniform(-3.0, 3.0, starts.shape)
