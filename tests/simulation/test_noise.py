"""Noise is declared by names, has the variances of Table II, and its draws do not depend on them."""

from __future__ import annotations

import re

import numpy as np
import pytest

import simbias
from simbias.config.composition import ConfigError
from simbias.core.records import Disturbance
from simbias.simulation.noise import Noise
from simbias.trial.study import Study

FRAMES, N = 5000, 6
VARIANCES = {"torque_variance": 0.1, "angle_variance": 1e-6, "velocity_variance": 1e-3}


def draw(study: Study, variances: dict[str, float], seed: int = 0) -> Disturbance:
    return Noise(study.task, variances).draw(np.random.default_rng(seed))


def test_one_torque_per_frame_and_one_measurement_per_state(study: Study) -> None:
    disturbance = draw(study, VARIANCES)
    assert disturbance.inputs.shape == (FRAMES, 1)
    assert disturbance.sensors.shape == (FRAMES + 1, N)


def test_default_is_no_noise(study: Study) -> None:
    assert Noise(study.task, {}).is_silent
    assert not Noise(study.task, VARIANCES).is_silent


def test_every_kind_has_its_own_variance(study: Study) -> None:
    """In 99.9 % of all seeds: sum x^2 / variance is chi-square."""
    from scipy.stats import chi2, kstest  # lazily: it takes a second

    drawn = draw(study, VARIANCES)
    samples = (
        (drawn.inputs, VARIANCES["torque_variance"]),
        (drawn.sensors[:, :3], VARIANCES["angle_variance"]),
        (drawn.sensors[:, 3:], VARIANCES["velocity_variance"]),
    )
    for values, variance in samples:
        lower, upper = chi2.interval(0.999, values.size)
        assert lower < np.sum(values**2) / variance < upper
        assert kstest(values.ravel() / np.sqrt(variance), "norm").pvalue > 1e-3


def test_a_quantitys_own_variance_comes_before_its_kinds(study: Study) -> None:
    noise = Noise(study.task, {"theta_variance": 4.0, "angle_variance": 1.0, "d_theta_variance": 9.0})
    np.testing.assert_array_equal(noise.sensor_variance, [1, 1, 4, 0, 0, 9])
    np.testing.assert_array_equal(noise.input_variance, [0])


def test_noise_is_independent_between_frames_and_sensors(study: Study) -> None:
    drawn = draw(study, VARIANCES)
    columns = np.column_stack((drawn.inputs[:-1], drawn.inputs[1:], drawn.sensors[1:-1], drawn.sensors[2:]))
    correlations = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlations).max() < 5 / np.sqrt(FRAMES)  # five standard deviations


@pytest.mark.parametrize("factor", [0.0, 4.0])
def test_draws_do_not_depend_on_the_variances(study: Study, factor: float) -> None:
    first, second = np.random.default_rng(1), np.random.default_rng(1)
    one = Noise(study.task, VARIANCES).draw(first)
    other = Noise(study.task, VARIANCES | {"angle_variance": factor * 1e-6}).draw(second)
    np.testing.assert_array_equal(other.inputs, one.inputs)
    np.testing.assert_allclose(other.sensors[:, :3], np.sqrt(factor) * one.sensors[:, :3], rtol=1e-12)
    np.testing.assert_array_equal(other.sensors[:, 3:], one.sensors[:, 3:])
    assert first.random() == second.random()


@pytest.mark.parametrize("key", ["colour_variance", "torque", "alpha_f_variance"])
def test_what_the_task_has_not_is_an_error_in_one_line(key: str) -> None:
    message = (
        f"hardware: no noise is called {key}; there is alpha_b_variance, alpha_w_variance, angle_variance"
    )
    with pytest.raises(ConfigError, match=re.escape(message)):
        simbias.load(["tracking=none", f"+hardware.noise.{key}=0.1"])


def test_zeros_are_as_if_nothing_was_declared() -> None:
    quiet, noisy = (
        simbias.load(["tracking=none", "evaluation=robust", f"hardware.noise.torque_variance={variance}"])
        for variance in (0.0, 0.1)
    )
    assert quiet.evaluation._noise.is_silent
    assert noisy.evaluation._noise.input_variance == 0.1
