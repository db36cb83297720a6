"""Noise has the variances of Table II, and its draws do not depend on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from simbias.simulation.noise import Noise

NOISE = Noise(torque_variance=0.1, angle_variance=1e-6, velocity_variance=1e-3)
FRAMES, N, M = 5000, 6, 1


def draw(noise: Noise, seed: int = 0, frames: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    return noise.draw(np.random.default_rng(seed), frames, N, M)


def test_one_torque_per_frame_and_one_measurement_per_state() -> None:
    torque, sensors = draw(NOISE)
    assert torque.shape == (FRAMES, M)
    assert sensors.shape == (FRAMES + 1, N)


def test_default_is_no_noise() -> None:
    torque, sensors = draw(Noise())
    assert not torque.any()
    assert not sensors.any()


def test_each_half_of_the_state_has_its_own_variance() -> None:
    """In 99.9 % of all seeds: sum x^2 / variance is chi-square."""
    torque, sensors = draw(NOISE)
    samples = (
        (torque, NOISE.torque_variance),
        (sensors[:, :3], NOISE.angle_variance),
        (sensors[:, 3:], NOISE.velocity_variance),
    )
    for values, variance in samples:
        lower, upper = chi2.interval(0.999, values.size)
        assert lower < np.sum(values**2) / variance < upper
        assert kstest(values.ravel() / np.sqrt(variance), "norm").pvalue > 1e-3


def test_noise_is_independent_between_frames_and_sensors() -> None:
    torque, sensors = draw(NOISE)
    columns = np.column_stack((torque[:-1], torque[1:], sensors[1:-1], sensors[2:]))
    correlations = np.corrcoef(columns.T) - np.eye(columns.shape[1])
    assert np.abs(correlations).max() < 5 / np.sqrt(FRAMES)  # five standard deviations


@pytest.mark.parametrize("other", [Noise(), Noise(angle_variance=4e-6), Noise(0.4, 4e-6, 4e-3)])
def test_draws_do_not_depend_on_the_variances(other: Noise) -> None:
    first, second = np.random.default_rng(1), np.random.default_rng(1)
    torque, sensors = NOISE.draw(first, 10, N, M)
    other_torque, other_sensors = other.draw(second, 10, N, M)
    scale = np.sqrt(np.repeat([other.angle_variance / 1e-6, other.velocity_variance / 1e-3], 3))
    np.testing.assert_allclose(other_torque, np.sqrt(other.torque_variance / 0.1) * torque, rtol=1e-12)
    np.testing.assert_allclose(other_sensors, scale * sensors, rtol=1e-12)
    assert first.random() == second.random()
