"""Checks that components of a group have to pass: registry, expectations, and test points."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core.records import Array, Rollout, Transitions
from simbias.trial.study import Study

POINTS = 12  # states and inputs at which methods are tested
DATA = 20  # transitions to which a bias is fitted
SECONDS = 0.2  # of a rollout to learn from
WRITES = re.compile("(?<!source array) is read-only|modify read-?only")  # by NumPy, Numba; Cython only reads


@dataclass(frozen=True)
class Check:
    """A check that components of a group have to pass."""

    group: str
    words: str
    run: Callable[[Study], None]
    rehearsed: bool = False  # whether every trial runs it first on a custom component, whatever its group

    def __str__(self) -> str:
        return f"{self.group}: {self.words}"


CHECKS: list[Check] = []


def check(
    group: str, words: str, rehearsed: bool = False
) -> Callable[[Callable[[Study], None]], Callable[[Study], None]]:
    """Register a check."""

    def register(run: Callable[[Study], None]) -> Callable[[Study], None]:
        CHECKS.append(Check(group, words, run, rehearsed))
        return run

    return register


class ConformanceError(AssertionError):
    """A component breaks its contract; one line with method, expected and got."""


def expect(condition: Any, method: str, expected: str, got: Any) -> None:
    """Raise a ConformanceError unless the condition holds."""
    if not condition:
        raise ConformanceError(f"{method}: expected {expected}, got {' '.join(str(got).split())[:120]}")


def equal(a: Any, b: Any, method: str, expected: str, tolerance: float = 1e-9) -> None:
    """Compare two arrays; raise a ConformanceError if they differ."""
    expect(np.shape(a) == np.shape(b), method, f"the shape {np.shape(b)}", np.shape(a))
    expect(np.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True), method, expected, a)


def states(study: Study) -> Array:
    """States (POINTS, n) near the start."""
    rng = np.random.default_rng(0)
    return np.array([study.task.draw_start(rng) for _ in range(POINTS)])


def robot_states(study: Study) -> Array:
    """States (POINTS, n) of the robot near the start, without targets."""
    return states(study)[:, : len(study.task.without_targets.states)]


def inputs(study: Study) -> Array:
    """Inputs (POINTS, m) within their limits."""
    lower, upper = np.nan_to_num(study.task.input_bounds, posinf=1.0, neginf=-1.0)
    return np.random.default_rng(1).uniform(lower, upper, (POINTS, len(study.task.inputs)))


def policies(study: Study) -> Array:
    """Policies (POINTS, p) in the box."""
    lower, upper = np.sort(study.policy.bounds, axis=0)  # an empty box is reported elsewhere
    return np.random.default_rng(2).uniform(lower, upper, (POINTS, len(lower)))


def near_zero(study: Study) -> Array:
    """The policy (p,) of the box nearest to zero, the only one that hardware runs."""
    return np.clip(0.0, *study.policy.bounds)


def _in_a_grid(array: Array) -> Array:
    """Reshape rows (POINTS, k) to two leading axes."""
    return array.reshape(POINTS // 3, 3, -1)


def expect_any_leading_axes(method: Callable[..., Any], name: str, *arrays: Array) -> None:
    """Expect a method to give the same for an array of points as for each, without changing arguments."""
    expect_arguments_left(method, name, *arrays)
    made = [method(*rows) for rows in zip(*arrays, strict=True)]
    shapes = {np.shape(one) for one in made}
    expect(len(shapes) == 1, name, "the same shape for each point", shapes)
    each = np.array(made)
    equal(method(*arrays), each, name, "for several points what it gives for each")
    grid = method(*map(_in_a_grid, arrays))
    equal(grid, _in_a_grid(each), name, "the same with two leading axes")


def expect_arguments_left(method: Callable[..., Any], name: str, *arrays: Array) -> None:
    """Expect a method not to write into its arguments; its other errors are reported elsewhere."""
    expected, copies = "its arguments to be left as they are", [array.copy() for array in arrays]
    for copy in copies:
        copy.setflags(write=False)
    try:
        method(*copies)
    except Exception as error:
        expect(not WRITES.search(str(error)), name, expected, error)
    for copy, array in zip(copies, arrays, strict=True):  # writes through pointers raise nothing
        expect(np.array_equal(copy, array), name, expected, copy)


def transitions(study: Study) -> Transitions:
    """Transitions whose residuals are smooth functions of the states."""
    rng = np.random.default_rng(8)
    x = np.array([study.task.without_targets.draw_start(rng) for _ in range(DATA)])
    u = rng.normal(size=(DATA, len(study.task.inputs)))
    return Transitions(np.concatenate([x, u], axis=1), 1e-3 * np.sin(3.0 * x))


def rollout(study: Study, seed: int = 0) -> Rollout:
    """A simulated rollout from a random start."""
    start = study.task.draw_start(np.random.default_rng(seed))
    return study.simulate(near_zero(study), start=start)
