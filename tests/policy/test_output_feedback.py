from copy import copy

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simbias.core import Quantity
from simbias.policy.output_feedback import OutputFeedback
from simbias.trial.study import Study

H_HATS = st.lists(st.floats(-10, 10), min_size=5, max_size=5).map(np.array)


def act(study: Study, theta: np.ndarray, x: np.ndarray) -> np.ndarray:
    return study.policy.controller(theta, study.task.time_step)(x)


def test_gains_are_equation_10(study: Study) -> None:
    gains = study.policy.gains(np.array([0.0, 1.0, -1.0, 10.0, -10.0]))
    e, e10 = np.exp(1.0), np.exp(10.0)
    np.testing.assert_allclose(gains, [[0, e - 1, 1 - e, e10 - 1, 1 - e10]], rtol=1e-12)
    np.testing.assert_array_equal(study.policy.bounds, [[-10] * 5, [10] * 5])  # Table I
    broken = act(study, np.full(5, np.nan), study.task.start_mean)
    assert np.isnan(broken).all()  # it must not pass as zero torque


@settings(max_examples=25, deadline=None)
@given(H_HATS)
def test_torque_is_equation_9_within_the_limit(study: Study, theta: np.ndarray) -> None:
    x = np.array([0.02, -0.01, 0.015, 0.1, -0.1, 0.05])
    wanted = study.policy.gains(theta) @ study.task.output(x)
    np.testing.assert_allclose(act(study, theta, x), np.clip(wanted, -100, 100), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(act(study, -theta, x), -act(study, theta, x), rtol=1e-9, atol=1e-9)


def test_several_inputs_have_rows_of_gains(point_mass: Study) -> None:
    """H is (m, q)."""
    task = copy(point_mass.task)
    task.inputs, task.input_limit = (Quantity("a", "N"), Quantity("b", "N")), np.array([0.5, 5.0])
    policy = OutputFeedback(task)
    theta, x = np.array([2.0, -1.0, 0.5, 3.0]), np.array([0.1, 0.2])
    expected = np.clip(policy.gains(theta) @ x, -task.input_limit, task.input_limit)
    np.testing.assert_allclose(policy.controller(theta, 0.1)(x), expected, rtol=1e-12)


def test_it_imitates_its_own_inputs(study: Study) -> None:
    policy = OutputFeedback(study.task)
    theta = np.array([3.0, -2.0, 1.0, 0.5, -4.0])
    states = 0.01 * np.random.default_rng(0).normal(size=(3, 20, 6))
    answers, _ = policy.act(theta, states, 0.0, np.zeros((3, 20, 0)))
    np.testing.assert_allclose(policy.imitating(states, answers), theta, rtol=1e-6)
