"""What learning from windows is made of, against differences, plain sums and limits that theory gives."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from models import driven

from simbias.core import Nominal
from simbias.core.records import Array, Rollout, Transitions
from simbias.learning.bias.posterior import GPSample
from simbias.learning.bias.window_gp import (
    BATCH,
    WindowGP,
    WindowPosterior,
    features,
    root,
    sensitivities,
)
from simbias.learning.covariance import Hyperparameters
from simbias.simulation.open_loop import PredictionModel, Windows, predict

pytestmark = pytest.mark.usefixtures("plain_predictions")  # `test_window_gp.py` has compiled ones

NO_DATA = Transitions(np.empty((0, 3)), np.empty((0, 2)))


class Oscillator(Nominal):
    """A hardening spring, driven through a lag that its memory keeps."""

    state_size = 1

    def __init__(self, missing: float = 0.0) -> None:
        self._missing = missing  # a force that the model does not know

    def step(self, x: Array, u: Array) -> Array:
        return self.advance(x, u, u)[0]

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        force = memory + 0.3 * (u - memory)
        pull = force[..., 0] - 4.0 * x[..., 0] - 9.0 * x[..., 0] ** 3 + self._missing * np.cos(x[..., 0])
        velocity = 0.99 * x[..., 1] + 0.02 * pull
        return np.stack([x[..., 0] + 0.02 * velocity, velocity], axis=-1), force


def experiment(nominal: Nominal, frames: int, seed: int) -> Rollout:
    rng = np.random.default_rng(seed)
    u = 3.0 * np.sin(rng.uniform(1, 4) * 0.02 * np.arange(frames))[:, None]
    states, memory = [rng.uniform(-0.5, 0.5, 2)], np.zeros(1)
    for each in u:
        x, memory = nominal.advance(states[-1], each, memory)
        states.append(x + 1e-3 * rng.standard_normal(2))
    return Rollout(np.array(states), u)


def hyper(r: int = 3) -> Hyperparameters:
    return Hyperparameters(np.array([0.5, 1.0, 3.0])[:r], np.full(r, 1.5), 1.0, 0.0, 0.0)


def points(R: int) -> Array:
    return np.random.default_rng(7).uniform(-1, 1, (R, 3))


def task(time_step: float = 0.02) -> Any:
    return SimpleNamespace(time_step=time_step)


def test_sensitivities_are_those_of_differences() -> None:
    """With a memory, and more windows than are differentiated together."""
    nominal, Z = Oscillator(), points(3)
    windows = Windows.of([experiment(nominal, frames, frames) for frames in (320, 130)], 6, 3)
    assert len(windows) > BATCH
    got = sensitivities(nominal, windows, features(hyper(), Z))
    U, small, columns = root(hyper(), Z), 1e-4, []
    for weights in small * np.eye(6):  # of three functions in each of two states
        W = U.T @ weights.reshape(2, 3).T
        there, back = (
            predict([PredictionModel(nominal)], windows, GPSample(hyper(), Z, sign * W))[0]
            for sign in (1, -1)
        )
        columns.append((there - back) / (2 * small))
    expected = np.stack(columns, axis=-1)  # (w, J, n, n R)
    np.testing.assert_allclose(got, expected, atol=1e-4 * np.abs(expected).max())


def learned(missing: float = 2.0, **options: Any) -> Any:
    robot = Oscillator(missing)
    rollouts = [experiment(robot, frames, frames) for frames in (160, 140)]
    given: Any = {"segment": 0.5, "signals": (1.0,), "length_scales": (2.0,)} | options
    return WindowGP(task(), **given).learn(NO_DATA, rollouts, Oscillator()), rollouts


def test_the_shortest_length_and_the_best_signal_are_taken() -> None:
    assert learned(length_scales=(4.0, 2.0))[0].diagnostics["length_scale"] == 2.0
    signals = (0.01, 1.0, 0.1)
    gains = [learned(signals=(each,))[0].diagnostics["gain"] for each in signals]
    assert gains[1] == max(gains) > 1.1 * gains[2] > 1.1**2 * gains[0] > 0
    fitted, rollouts = learned(signals=signals)
    assert fitted.diagnostics["gain"] == gains[1]
    inputs = np.concatenate([np.concatenate([r.states[:-1], r.inputs], axis=1) for r in rollouts])
    missing = 0.02 * 2.0 * np.cos(inputs[:, 0])
    error = fitted.predict(inputs)[0][:, 1] - missing
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean(missing**2))


def test_two_folds_are_enough_and_an_input_may_never_change() -> None:
    assert isinstance(learned(folds=2)[0], WindowPosterior)
    nothing, rollouts = learned(folds=1)
    assert not isinstance(nothing, WindowPosterior)
    still = [Rollout(each.states, np.zeros_like(each.inputs)) for each in rollouts]
    fitted = WindowGP(task(), segment=0.5).learn(NO_DATA, still, Oscillator())
    assert np.isfinite(fitted.predict(np.zeros((2, 3)))[0]).all()


class Decay(Nominal):
    """Two states that know nothing of each other."""

    def __init__(self, missing: float = 0.0) -> None:
        self._missing = missing

    def step(self, x: Array, u: Array) -> Array:
        return np.stack([0.99 * x[..., 0], 0.99 * x[..., 1] + 0.02 * (u[..., 0] + self._missing)], axis=-1)


@pytest.mark.filterwarnings("error")
def test_a_state_that_is_predicted_exactly_has_no_bias() -> None:
    """Nor does it disturb what is learned of another."""
    for missing in (0.0, 2.0):
        rng, robot, rollouts = np.random.default_rng(0), Decay(missing), []
        for _ in range(2):
            u = 3.0 * np.sin(rng.uniform(1, 4) * 0.02 * np.arange(150))[:, None]
            rollouts.append(Rollout(driven(robot, np.ones(2), u), u))
        fitted = WindowGP(task(), segment=0.5).learn(NO_DATA, rollouts, Decay())
        inputs = np.concatenate([rollouts[0].states[:-1], rollouts[0].inputs], axis=1)
        mean, variance = fitted.predict(inputs)
        np.testing.assert_allclose(mean[:, 0], 0.0, atol=1e-9)
        np.testing.assert_allclose(np.median(mean[:, 1]), 0.02 * missing, rtol=0.3)
        assert np.isfinite(variance).all()
        assert np.abs(fitted.draw(rng).predict(np.zeros((1, 3)))[0][0, 0]) < 1e-9


def test_before_data_the_variance_is_the_signals() -> None:
    """Everywhere; known weights leave only what the points do not see: nothing at them, all far away."""
    Z, signal = points(5), np.array([0.5, 3.0])
    at_points = Z * hyper().input_scale * hyper().length_scale
    phi = features(hyper(), Z)(at_points)  # whose weights are independent
    np.testing.assert_allclose(phi @ phi.T, hyper().covariance(Z, Z), atol=1e-5)
    inputs = np.concatenate([at_points, at_points + 0.2, at_points + 100.0])

    def variance(covariance: Array) -> Array:
        return WindowPosterior(hyper(), Z, np.zeros(10), covariance, signal, {}).predict(inputs)[1]

    prior = np.repeat(signal**2, 5)
    np.testing.assert_allclose(variance(np.diag(prior)), np.tile(signal**2, (15, 1)), rtol=1e-9)
    known = variance(np.zeros((10, 10))) / signal**2
    np.testing.assert_allclose(known[:5], 0.0, atol=1e-5)
    np.testing.assert_allclose(known[10:], 1.0)
    assert ((known[5:10] > 0.0) & (known[5:10] < 1.0)).all()
