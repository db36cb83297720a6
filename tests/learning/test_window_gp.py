"""A residual that is learned from windows: found where there is one, none where there is not."""

import numpy as np
import pytest
from in_numpy import predict_in_numpy
from pendulum import NOISE, experiment, pendulum

from simbias.core import Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.bias.window_gp import WindowGP
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict
from simbias.trial.study import Study


class Sprung(Nominal):
    """The double pendulum with a hardening spring in its second joint, that no parameter knows."""

    def __init__(self, nominal: Nominal) -> None:
        self._nominal = nominal

    def step(self, x: Array, u: Array) -> Array:
        torque = np.stack([np.zeros_like(x[..., 1]), -0.2 * x[..., 1] ** 3], axis=-1)
        return self._nominal.step(x, u + torque)


@pytest.fixture(scope="module")
def study() -> Study:
    damping = [f"nominal.drives.damping_{i}=0.05" for i in (1, 2)]
    return pendulum("bias=window_gp", "bias.points=30", *damping)


def error(study: Study, fitted: object, rollouts: list[Rollout]) -> float:
    windows = Windows.of(rollouts, 50, 5)
    e = plain([PredictionModel(study.nominal)], windows, fitted)[0] - windows.means  # type: ignore[arg-type]
    return float(np.sqrt(np.mean(e[:, -1, 2:] ** 2)))


@pytest.mark.slow
def test_it_finds_what_the_model_lacks(study: Study) -> None:
    """Its mean is weighted by Eq. 7 if asked for."""
    rng, robot = np.random.default_rng(0), Sprung(study.nominal)
    learned = [experiment(robot, rng, 1500) for _ in range(2)]
    other = experiment(robot, rng, 500, np.zeros(4))
    with pytest.MonkeyPatch.context() as patch:
        predict_in_numpy(patch)
        fitted, weighted = (
            bias.learn(study.no_data, learned, study.nominal)
            for bias in (study.bias, WindowGP(study.task, points=30, d=1.0))
        )
    without = error(study, study.bias.fit(study.no_data), [other])
    assert error(study, fitted, [other]) < 0.95 * without
    inputs = np.concatenate([other.states[:-1], other.inputs], axis=1)[::50]
    mean, variance = fitted.predict(inputs)
    np.testing.assert_allclose(mean, fitted.correction(inputs[:, :4], inputs[:, 4:]), atol=1e-9)
    draws = np.array([fitted.draw(np.random.default_rng(i)).predict(inputs)[0] for i in range(200)])
    np.testing.assert_allclose(draws.mean(axis=0), mean, atol=5 * np.sqrt(variance.max() / 200))
    assert (draws.std(axis=0) <= 1.3 * np.sqrt(variance) + 1e-9).all()
    inputs = np.concatenate([inputs, inputs * 3.0, inputs + 100.0])
    mean, variance = weighted.predict(inputs)
    weight = np.exp(-np.sum(variance / variance[-1], axis=1, keepdims=True))  # the last is the prior's
    assert weight[0] > 10 * weight[-1]
    np.testing.assert_allclose(weight[-1], np.exp(-4.0))
    np.testing.assert_allclose(weighted.correction(inputs[:, :4], inputs[:, 4:]), weight * mean, rtol=1e-6)
    asked = [PredictionModel(study.nominal)], Windows.of([other], 50, 5), weighted
    np.testing.assert_allclose(predict(*asked), plain(*asked), atol=1e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_predictions")
def test_where_the_model_is_right_little_is_learned(study: Study) -> None:
    """Mostly nothing at all, as a gain has to exceed its standard error; never what harms elsewhere."""
    zero, ratios = study.bias.fit(study.no_data), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        seen, other = (experiment(study.nominal, rng, 1000, NOISE) for _ in range(2))
        fitted = study.bias.learn(study.no_data, [seen], study.nominal)
        ratios.append(error(study, fitted, [other]) / error(study, zero, [other]))
    assert ratios.count(1.0) >= 2
    assert max(ratios) < 1.02


@pytest.mark.usefixtures("plain_predictions")
def test_too_little_is_nothing(study: Study) -> None:
    short = experiment(study.nominal, np.random.default_rng(0), 60)
    for rollouts in ([], [short]):
        fitted = study.bias.learn(study.no_data, rollouts, study.nominal)
        assert not fitted.predict(np.ones((2, 6)))[0].any()
