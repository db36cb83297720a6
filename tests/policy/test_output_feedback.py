from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simbias.study import Study

H_HATS = st.lists(st.floats(-10, 10), min_size=5, max_size=5).map(np.array)
OUTPUTS_AT_THE_REFERENCE = [-0.07885799, -0.30512553, 0.08, 0.5, 0.05]  # shared definitions of the bongoboard


def test_gains_are_equation_10(study: Study) -> None:
    gains = study.policy.gains(np.array([0.0, 1.0, -1.0, 10.0, -10.0]))
    e, e10 = np.exp(1.0), np.exp(10.0)
    np.testing.assert_allclose(gains, [[0, e - 1, 1 - e, e10 - 1, 1 - e10]], rtol=1e-12)


def test_outputs_at_the_reference_state(study: Study) -> None:
    x = np.array([0.1, -0.05, 0.08, 0.3, -0.2, 0.5])
    np.testing.assert_allclose(study.policy.outputs(x), OUTPUTS_AT_THE_REFERENCE, atol=1e-8)


@given(H_HATS)
def test_torque_is_equation_9_within_the_limit(study: Study, theta: np.ndarray) -> None:
    x = np.array([0.02, -0.01, 0.015, 0.1, -0.1, 0.05])
    wanted = study.policy.gains(theta) @ study.policy.outputs(x)
    np.testing.assert_allclose(study.policy.act(theta, x), np.clip(wanted, -100, 100), rtol=1e-9, atol=1e-9)


@given(H_HATS)
def test_policy_is_odd_in_its_parameters(study: Study, theta: np.ndarray) -> None:
    """Eq. 10 maps -h-hat to -h."""
    x = np.array([0.02, -0.01, 0.015, 0.1, -0.1, 0.05])
    np.testing.assert_allclose(study.policy.act(-theta, x), -study.policy.act(theta, x), rtol=1e-9, atol=1e-9)


def test_bounds_are_table_1s(study: Study) -> None:
    lower, upper = study.policy.bounds
    assert study.policy.n_parameters == 5
    np.testing.assert_array_equal(lower, -10)
    np.testing.assert_array_equal(upper, 10)


def test_what_is_not_a_number_stays_visible(study: Study) -> None:
    """A broken policy must not pass as zero torque."""
    assert np.isnan(study.policy.act(np.full(5, np.nan), study.task.start_mean)).all()


@given(H_HATS)
def test_kernel_agrees_with_act(study: Study, theta: np.ndarray) -> None:
    x = np.array([0.02, -0.01, 0.015, 0.1, -0.1, 0.05])
    function, parameters = study.policy.kernel(theta)
    u = np.empty(1)
    function(study.policy.outputs(x), parameters, u)
    np.testing.assert_allclose(u, study.policy.act(theta, x), rtol=1e-9, atol=1e-9)
