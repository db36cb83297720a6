"""The controller of an order is the policy, in C and in Python."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from point_mass import PointMass

import simbias
from simbias.core import Kernel, Policy, Task
from simbias.core.records import Array
from simbias.lab.requests.controller import c_header, derive, python_module
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.requests.symbols import UntraceableError
from simbias.lab.safety import Bounds
from simbias.policy.output_feedback import OutputFeedback
from simbias.trial.study import Study

COMPILER = shutil.which("cc") or shutil.which("gcc")
THETA = np.array([1.0, -2.0, 3.0, 0.5, -1.0])


def _integral(z, parameters, t, memory):
    """A law with memory that depends on time."""
    gain, limit = parameters
    total = memory[0] + z[0]
    return (min(max(-gain * total * t + abs(z[1]), -limit), limit),), (total,)


class Integral(Policy):
    n_parameters = 1
    memory_size = 1
    bounds = (np.zeros(1), np.ones(1))

    def __init__(self, task: Task) -> None:
        self.kernel = lambda thetas: Kernel(_integral, np.array([[theta[0], 5.0] for theta in thetas]))

    def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
        u, kept = _integral(x, (theta[0], 5.0), t, memory)
        return np.array(u), np.array(kept)

    def outputs(self, x: Array) -> Array:
        return x


class Branching(Integral):
    def __init__(self, task: Task) -> None:
        self.kernel = lambda thetas: Kernel(lambda z, p: (z[0] if z[0] > 0 else -z[0],), thetas)


def in_python(order: ExperimentRequest) -> Callable[..., Any]:
    names: dict[str, Any] = {}
    law = derive(order.task, order.policy, order.theta)
    exec(python_module(order.task, law, "a test", order.bounds), names)
    return names["control"]


def in_c(order: ExperimentRequest, states: Array, folder: Path) -> Array:
    """What the header gives for states (k, n): whether to abort, then the inputs (k, 1 + m)."""
    law = derive(order.task, order.policy, order.theta)
    (folder / "controller.h").write_text(c_header(order.task, law, "a test", order.bounds))
    n, m, s = len(order.task.states), len(order.task.inputs), order.policy.memory_size
    more, declared = (", t, memory", f"double memory[{s}] = {{0}};") if s else ("", "")
    (folder / "main.c").write_text(
        f"""#include <stdio.h>
#include "controller.h"
int main(void) {{
    double x[{n}], u[{m}], t = 0.0; {declared}
    for (;;) {{
        for (int i = 0; i < {n}; ++i) if (scanf("%lf", &x[i]) != 1) return 0;
        printf("%d", simbias_control(x, u{more}));
        for (int i = 0; i < {m}; ++i) printf(" %.17g", u[i]);
        printf("\\n"); t += SIMBIAS_TIME_STEP;
    }}
}}
"""
    )
    assert COMPILER is not None
    flags = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2"]
    program = folder / "main"
    subprocess.run([COMPILER, *flags, "-o", program, folder / "main.c", "-lm"], check=True)
    text = "\n".join(" ".join(map(repr, row)) for row in states.tolist())
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    return np.array([line.split() for line in done.stdout.splitlines()], dtype=float)


@pytest.fixture
def order(study: Study) -> ExperimentRequest:
    return ExperimentRequest(study.task, study.policy, THETA, study.task.start_mean)


def test_python_gives_the_policys_inputs(order: ExperimentRequest, study: Study) -> None:
    control, states = in_python(order), 0.3 * np.random.default_rng(0).standard_normal((50, 6))
    expected = study.policy.act(THETA, states, 0.0, np.zeros((50, 0)))[0]
    np.testing.assert_allclose([control(x) for x in states], expected, rtol=1e-12, atol=1e-12)
    assert np.abs(expected).max() < 100.0  # none is cut off
    with pytest.raises(ValueError, match="abort: x = "):
        control(np.full(6, np.nan))


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_c_gives_the_policys_inputs_and_refuses_what_is_no_number(
    order: ExperimentRequest, study: Study, tmp_path
) -> None:
    states = 0.3 * np.random.default_rng(0).standard_normal((50, 6))
    states[7, 2] = np.nan
    expected = study.policy.act(THETA, states, 0.0, np.zeros((50, 0)))[0]
    made = in_c(order, states, tmp_path)
    assert np.flatnonzero(made[:, 0]).tolist() == [7]
    expected[7] = 0.0
    np.testing.assert_allclose(made[:, 1:], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_memory_and_time_pass_from_frame_to_frame(tmp_path: Path) -> None:
    task = PointMass()
    order = ExperimentRequest(task, Integral(task), np.array([3.0]), task.start_mean)
    states = np.random.default_rng(1).standard_normal((20, 2))
    controller, control, memory = order.controller(), in_python(order), np.zeros(1)
    expected, by_python = [], []
    for frame, x in enumerate(states):
        expected.append(controller(x))
        u, memory = control(x, frame * task.time_step, memory)
        by_python.append(u)
    np.testing.assert_allclose(by_python, expected, rtol=1e-12)
    np.testing.assert_allclose(in_c(order, states, tmp_path)[:, 1:], expected, rtol=1e-12)


def test_outputs_that_nobody_can_say_are_what_the_controller_is_given() -> None:
    class Squares(PointMass):
        def output(self, x: Array) -> Array:
            return x**2

    task = Squares()
    order = ExperimentRequest(task, OutputFeedback(task), np.array([1.0, -1.0]), task.start_mean)
    z = np.array([0.3, 0.2])
    np.testing.assert_allclose(in_python(order)(z), OutputFeedback(task).gains(order.theta) @ z)
    assert "def control(z)" in python_module(task, derive(task, order.policy, order.theta), "", order.bounds)


def test_a_policy_that_is_no_formula_says_why() -> None:
    task = PointMass()
    with pytest.raises(UntraceableError, match="is no formula"):
        derive(task, Branching(task), np.zeros(1))
    own = simbias.core.Policy
    with pytest.raises(UntraceableError, match="has no kernel"):
        derive(task, type("Plain", (Integral,), {"__init__": lambda self, task: None})(task), np.zeros(1))
    assert own.law(Integral(task), np.ones(1)).words == "u = Integral.act(theta, x, t, memory)"


def test_limits_are_in_the_order_and_held_by_its_controller(order: ExperimentRequest, study: Study) -> None:
    class Limited(ExperimentRequest):
        bounds = Bounds(
            (np.array([-5.0]), np.array([5.0])), np.array([np.inf]), np.array([0.2, *[np.inf] * 5]), False
        )

    limited = Limited(study.task, study.policy, THETA, study.task.start_mean)
    content = limited.content()
    assert content["states"][0]["limit"] == 0.2
    assert content["states"][1]["limit"] is None
    assert content["inputs"] == [
        {"name": "torque", "unit": "N m", "limit": 5.0, "limit_of_change_per_s": None}
    ]
    control = in_python(limited)
    assert np.abs(control(np.zeros(6))).max() == 0.0
    with pytest.raises(ValueError, match="abort"):
        control(np.array([0.21, 0, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="abort"):
        control(np.array([0.0, 0, 3.0, 0, 0, 0]))


def test_an_orders_name_is_that_of_its_experiment(order: ExperimentRequest, study: Study) -> None:
    again = ExperimentRequest(study.task, study.policy, THETA.copy(), order.start.copy())
    assert again.name == order.name
    for other in (
        ExperimentRequest(study.task, study.policy, THETA + 1e-9, order.start),
        ExperimentRequest(study.task, study.policy, THETA, order.start + 1e-9),
        ExperimentRequest(study.task, study.policy, THETA, order.start, token=1),
    ):
        assert other.name != order.name
