"""Noise is declared by names, has the variances of Table II, and its draws do not depend on them."""

import numpy as np
import pytest

import simbias
from simbias.config.composition import ConfigError
from simbias.simulation.noise import Noise
from simbias.trial.study import Study

VARIANCES = {"torque_variance": 0.1, "angle_variance": 1e-6, "velocity_variance": 1e-3}


def test_every_kind_has_its_own_variance(study: Study) -> None:
    """To four standard errors; values are normal, frames and sensors are independent."""
    drawn = Noise(study.task, VARIANCES).draw(np.random.default_rng(0))
    samples = (
        (drawn.inputs, VARIANCES["torque_variance"]),
        (drawn.sensors[:, :3], VARIANCES["angle_variance"]),
        (drawn.sensors[:, 3:], VARIANCES["velocity_variance"]),
    )
    for values, variance in samples:
        z, k = values.ravel() / np.sqrt(variance), values.size
        for power, moment, deviation in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
            assert abs(np.mean(z**power) - moment) < 4 * np.sqrt(deviation / k)
    columns = np.column_stack((drawn.inputs[:-1], drawn.inputs[1:], drawn.sensors[1:-1], drawn.sensors[2:]))
    correlations = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlations).max() < 5 / np.sqrt(study.task.horizon)  # five standard deviations


def test_a_quantitys_own_variance_comes_before_its_kinds(study: Study) -> None:
    noise = Noise(study.task, {"theta_variance": 4.0, "angle_variance": 1.0, "d_theta_variance": 9.0})
    np.testing.assert_array_equal(noise.sensor_variance, [1, 1, 4, 0, 0, 9])
    np.testing.assert_array_equal(noise.input_variance, [0])


def test_draws_do_not_depend_on_the_variances(study: Study) -> None:
    for factor in (0.0, 4.0):
        first, second = np.random.default_rng(1), np.random.default_rng(1)
        one = Noise(study.task, VARIANCES).draw(first)
        other = Noise(study.task, VARIANCES | {"angle_variance": factor * 1e-6}).draw(second)
        np.testing.assert_array_equal(other.inputs, one.inputs)
        np.testing.assert_allclose(other.sensors[:, :3], np.sqrt(factor) * one.sensors[:, :3], rtol=1e-12)
        np.testing.assert_array_equal(other.sensors[:, 3:], one.sensors[:, 3:])
        assert first.random() == second.random()


def test_what_the_task_has_not_is_an_error_and_zeros_are_silent(study: Study) -> None:
    with pytest.raises(ConfigError, match=r"^hardware: no noise is called colour_variance; available: tor"):
        simbias.load(["tracking=none", "+hardware.noise.colour_variance=0.1"])
    assert Noise(study.task, {}).is_silent
    assert Noise(study.task, {"torque_variance": 0.0}).is_silent
    assert not Noise(study.task, VARIANCES).is_silent
