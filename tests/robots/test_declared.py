"""A declared task against a class that says the same, and what a declaration may not say."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from errors import one_line
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import CARTPOLE, DOUBLE, declared, shipped_task

from simbias.config.components import construct
from simbias.config.identity import identity_fields
from simbias.core import Task
from simbias.simulation.compiler import Expressions
from simbias.simulation.compiler.choices import greater, lesser
from simbias.simulation.compiler.symbolic_arrays import row
from simbias.simulation.compiler.symbols import Trace
from simbias.simulation.compiler.written import written


@given(st.floats(-4, 4), st.floats(-4, 4))
@settings(deadline=None, max_examples=25)
def test_expressions_mean_what_they_say(a: float, b: float) -> None:
    """Numbers, arrays and the kernel agree with NumPy."""
    texts = {
        "sum": "1 + 2 * a - b / 3",
        "power": "-a**2 + b**3 - (a - b)**4",
        "functions": "sin(a) * cos(b) + abs(a) + sqrt(b**2) + atan2(a, 2 + b) + exp(-a / 2)",
        "extremes": "min(a, b, 1.5) - max(-a, b)",
        "names": "twice + c * pi",
    }
    expressions = Expressions(texts, ("a", "b"), {"c": 0.5}, {"twice": "2 * a"})
    expected = [
        1 + 2 * a - b / 3,
        -(a**2) + b**3 - (a - b) ** 4,
        np.sin(a) * np.cos(b) + abs(a) + abs(b) + np.arctan2(a, 2 + b) + np.exp(-a / 2),
        min(a, b, 1.5) - max(-a, b),
        2 * a + 0.5 * np.pi,
    ]
    np.testing.assert_allclose(expressions(np.array([a, b])), expected, atol=1e-9)
    np.testing.assert_allclose(
        expressions(np.full((2, 3, 2), [a, b])), np.full((2, 3, 5), expected), atol=1e-9
    )


def test_what_is_not_a_number_stays_none() -> None:
    """So that a rollout whose state is not a number fails, in NumPy and compiled."""
    for extreme, position in product(("min", "max"), range(3)):
        expression = Expressions({"extreme": f"{extreme}(a, b, c)"}, ("a", "b", "c"))
        x = np.ones(3)
        x[position] = np.nan
        assert np.isnan(expression(x))
        substitute = {"min": lesser, "max": greater}[extreme].substitute
        assert np.isnan(substitute(substitute(x[0], x[1]), x[2]))


def test_failure_is_the_first_criterion_that_is_beyond_its_limit() -> None:
    criteria = {
        "low": {"value": "position", "below": -1.0},
        "far": {"value": "position**2", "above": 4.0},
        "falls": {"value": "max(angle, -angle)", "above": 0.5},
    }
    task = declared(failure=criteria)
    x = np.array([[0.0, 0.4], [-1.5, 1.0], [3.0, 0.0], [0.0, -0.6], [-1.0, 0.5]])
    assert task.violated(np.hstack([x, np.zeros((5, 2))])).tolist() == [-1, 0, 1, 2, -1]
    assert task.failure(np.array([3.0, 1.0, 0.0, 0.0])) == "far"


def test_only_an_upper_limit_of_a_state_bounds_it() -> None:
    """A goal of a state that must not come near zero is beyond that."""
    far, near = {"value": "abs(position)", "above": 2.0}, {"value": "abs(position)", "below": 0.2}
    goal = {"position": "0.5 + 0.1 * sin(t)"}
    task = declared(failure={"far": far, "near": near}, goal=goal)
    assert [criterion.bounds for criterion in task.criteria] == [{"position": 2.0}, {}]
    assert task.violated(np.array([[0.3, 0, 0, 0], [0.1, 0, 0, 0], [2.1, 0, 0, 0]])).tolist() == [-1, 1, 0]


def test_other_numbers_need_no_other_code() -> None:
    texts = []
    for number in (2.5, 3.5):
        trace = Trace()
        result = [list(Expressions({"f": f"{number} * a + sin(a)"}, ("a",))(row(trace, "x", 1))[0])]
        texts.append(written(trace, result, "x, p").function)
    assert texts[0] is texts[1]


def test_nothing_else_is_an_expression() -> None:
    for text in (
        *("__import__('os').system('true')", "a.real", "(lambda: 1)()", "[a for a in b]", "a if b else 1"),
        *("a < b", "a ** b", "a ** 1000000", "a and b", "'text'", "True", "1e400", "abs(a, b)", "abs(x=a)"),
        *("min(a)", "min(*a)", "eval(a)", "f'{a}'", "a[0]", "(a := 1)", "await a", "c", "1 +"),
        *("(" * 500 + "a" + ")" * 500, "-" * 900 + "a"),
    ):
        with one_line("^f: ", ValueError):
            Expressions({"f": text}, ("a", "b"))


def test_a_bad_declaration_is_one_line() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"inputs": {}}, "task: inputs is empty"),
        (
            {"failure": {"falls": {"value": "angel", "above": 1}}},
            "task: falls: 'angel': nothing is called an",
        ),
        ({"failure": {"falls": {"value": "angle"}}}, "task: failure.falls: one of above and below"),
        ({"states": {"a b": {"unit": "m"}}}, "task.states: 'a b' is no name"),
        ({"constants": {"angle": 1.0}}, "task: angle: two things have this name"),
        ({"states": {"x": {"unit": "m", "meen": 1}}}, "task.states.x.meen: no such key"),
        ({"drawing": {"rail": {"points": [["0", "nosuch"]]}}}, "task: drawing.rail.0.y: 'nosuch'"),
        ({"drawing": {"rail": {"points": [[0, 0, 0]]}}}, "task.drawing.rail.points.0: "),
    ]
    for changes, message in cases:
        with one_line() as error:
            declared(**changes)
        assert str(error.value).startswith(message)


def test_the_order_of_states_counts_in_the_identity() -> None:
    """A policy and a cost know them by their places."""
    turned = {**CARTPOLE, "states": dict(reversed(CARTPOLE["states"].items()))}
    one, other = (str(identity_fields({"task": config}, ())) for config in (CARTPOLE, turned))
    assert one != other


def test_the_drawing_is_to_scale() -> None:
    foot, tip = declared().points(np.array([0.3, 0.1, 0.0, 0.0]))["pole"]
    np.testing.assert_allclose(foot, [0.3, 0.0])
    np.testing.assert_allclose(tip - foot, 0.6 * np.array([np.sin(0.1), np.cos(0.1)]))


def test_a_file_draws_its_geoms() -> None:
    """Where the equations say that its poles are, which the declared drawing says too."""
    config = shipped_task("double_cartpole")
    of_file = construct({**config, "drawing": None, "figure": {"file": DOUBLE}}, Task, "task")
    x = np.array([0.3, 0.1, -0.2, 0.0, 0.0, 0.0])
    by_file, by_declaration = of_file.points(x), construct(config, Task, "task").points(x)
    for geom, part in (("cpole", "lower_pole"), ("cpole2", "upper_pole")):
        lower_end_first = by_file[geom][np.argsort(by_file[geom][:, 1])]
        np.testing.assert_allclose(lower_end_first, by_declaration[part], atol=1e-6)
    assert of_file.drawing["cpole"].thickness == pytest.approx(0.09)
    assert "floor" not in by_file
