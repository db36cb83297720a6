"""Whether a task can succeed: a two-link arm reaches a ring, and nothing beyond it."""

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simbias.config.components import construct
from simbias.core import StudyWarning, Task
from simbias.robots.declared.reach import nearest

UPPER, FORE, NEAR = 0.35, 0.3, 0.02  # m


def arm(**changes: Any) -> Task:
    """An arm whose hand is to be at a distance from its shoulder, in some direction, for the last second."""
    declared: dict[str, Any] = {
        "_target_": "simbias.robots.declared.task.Declared",
        "time_step": 0.05,
        "horizon": 40,
        "states": {name: {"unit": "rad", "mean": 0.5, "deviation": 0.2} for name in ("shoulder", "elbow")},
        "inputs": {"torque": {"unit": "N m", "limit": 1.0}},
        "outputs": {
            "x": {"value": "u * cos(shoulder) + f * cos(shoulder + elbow)", "unit": "m"},
            "y": {"value": "u * sin(shoulder) + f * sin(shoulder + elbow)", "unit": "m"},
        },
        "constants": {"u": UPPER, "f": FORE, "distance": 0.5, "bearing": 1.0},
        "goal": {"x": "distance * cos(bearing)", "y": "distance * sin(bearing)"},
        "success": {"near": {"value": "sqrt(x_error**2 + y_error**2)", "below": NEAR, "unit": "m"}},
        "hold": 1.0,
    }
    return construct(declared | changes, Task, "task")


def constants(distance: float, bearing: float = 1.0) -> dict[str, float]:
    return {"u": UPPER, "f": FORE, "distance": distance, "bearing": bearing}


@settings(deadline=None, max_examples=30)
@given(st.floats(0.0, 1.0), st.floats(-3.1, 3.1))
def test_a_hand_reaches_a_ring_and_nothing_beyond(distance: float, bearing: float) -> None:
    beyond = max(distance - (UPPER + FORE), (UPPER - FORE) - distance) - NEAR
    if abs(beyond) < 1e-3:
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        arm(constants=constants(distance, bearing))
    told = [str(each.message) for each in caught if "out of reach" in str(each.message)]
    assert bool(told) == (beyond > 0)
    for each in told:
        assert float(each.split("near is ")[1].split(" m")[0]) == pytest.approx(beyond + NEAR, rel=0.05)


def test_a_path_is_told_by_the_time_at_which_it_leaves_the_reach() -> None:
    leaving = {"x": "0.5 + 0.11 * t", "y": "0"}
    words = r"^success seems out of reach: .* near is .* m, not below 0.02 at t = 1.55 s$"
    with pytest.warns(StudyWarning, match=words):  # of the times that are tried, the first beyond 0.67 m
        arm(goal=leaving)


def test_targets_are_judged_one_by_one() -> None:
    targets = {"distance": {"unit": "m", "uniform": [0.5, 0.9]}}
    given = {"u": UPPER, "f": FORE, "bearing": 1.0}
    with pytest.warns(StudyWarning, match=r"^success seems out of reach for [2-7] of 8 drawn targets: "):
        arm(constants=given, targets=targets)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arm(constants=given, targets={"distance": {"unit": "m", "uniform": [0.1, 0.6]}})


def test_failures_are_no_successes() -> None:
    stretched = {"bent": {"value": "cos(elbow)", "above": 0.5, "words": "it stretches"}}
    folded = {name: {"unit": "rad", "mean": 2.0} for name in ("shoulder", "elbow")}
    with pytest.warns(StudyWarning, match="success seems out of reach"):
        arm(failure=stretched, states=folded, constants=constants(0.64))


def test_what_a_hand_reaches_within_its_joints_limits_is_in_reach() -> None:
    ends = {"shoulder": (-1.5, 1.5), "elbow": (-2.5, -0.1)}
    failure: dict[str, Any] = {
        f"{name}_low": {"value": name, "below": low} for name, (low, _) in ends.items()
    }
    failure |= {f"{name}_high": {"value": name, "above": high} for name, (_, high) in ends.items()}
    states = {name: {"unit": "rad", "mean": sum(each) / 2} for name, each in ends.items()}
    for shoulder, elbow in np.random.default_rng(0).uniform(*np.transpose([*ends.values()]), (30, 2)):
        x, y = (UPPER * f(shoulder) + FORE * f(shoulder + elbow) for f in (np.cos, np.sin))
        off = f"sqrt((u * cos(shoulder) + f * cos(shoulder + elbow) - ({x}))**2"
        off += f" + (u * sin(shoulder) + f * sin(shoulder + elbow) - ({y}))**2)"
        with warnings.catch_warnings(action="error"):
            arm(failure=failure, states=states, success={"there": {"value": off, "below": 0.01}})


def test_small_limits_are_as_good_as_large_ones_and_steep_ones_are_survived() -> None:
    squares = "x_error**2 + y_error**2"
    with warnings.catch_warnings(action="error"):
        for value, below in (
            (squares, 5e-7),
            (f"sqrt({squares})", 1e-6),
            ("abs(100 * (shoulder - 100))**3", 1.0),
        ):
            arm(success={"near": {"value": value, "below": below}})
        arm(failure={"off": {"value": "max(abs(shoulder) - 3, 0)", "above": 0.0}})
    for power in (2, 3, 4):
        steep = {"near": {"value": f"abs(57.3 * (shoulder + elbow - 6))**{power}", "below": 1.0}}
        arm(success=steep, constants=constants(0.5))
    with pytest.warns(
        StudyWarning, match=r"out of reach: in the nearest state found, there is .*, not below 0"
    ):
        arm(success={"there": {"value": "(shoulder - 1)**2", "below": 0.0}})


def test_nothing_is_said_of_conditions_without_slopes() -> None:
    steps = {"stepped": {"value": "min(max(1e9 * (shoulder - 9), 0), 1)", "above": 0.5}}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arm(success=steps)


def test_a_search_finds_zeros_and_stays_where_there_is_no_number() -> None:
    starts = np.array([[[0.0], [7.0]]])
    np.testing.assert_allclose(nearest(lambda x: np.abs(x - 3.0), starts, 1)[0, 0], 3.0, atol=1e-6)
    assert nearest(lambda x: np.where(x > 2.0, np.nan, 3.0 - x), starts[:, :1], 1)[0, 0] <= 2.0
    targets = np.array([[[0.0, 5.0], [1.0, 4.0]]])  # the second does not change
    found = nearest(lambda x: x[:, :1] - x[:, 1:], targets, 1)
    np.testing.assert_array_equal(found[..., 1], targets[..., 1])
    assert np.abs(found[..., 0] - found[..., 1]).min() < 1e-6
