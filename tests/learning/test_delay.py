"""The delay of motors, known from what states do; biases that are functions of the inputs that act."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interpreted import assert_alike, interpreted

import simbias
from simbias.core import FittedBias, Kernel, Nominal
from simbias.core.records import Array, Rollout
from simbias.simulation.closed_loop import simulator
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict
from simbias.trial.study import Study

pytestmark = pytest.mark.slow


@cache
def scratch() -> Study:
    return simbias.load(["preset=[pendulum_swingup,scratch]", "identification=delay", "tracking=none"])


def late_pendulum(study: Study, delay: float, frames: int, seed: int = 0) -> Rollout:
    """A pendulum whose torque acts `delay` frames late, a share of one included, under random inputs."""
    rng, h = np.random.default_rng(seed), study.task.time_step
    u = rng.uniform(-1, 1, (frames, 1)) * study.task.input_limit
    earlier = np.concatenate([np.zeros((4, 1)), u])
    whole, share = divmod(delay, 1.0)
    newer, older = (earlier[4 - int(whole) - k :][:frames] for k in (0, 1))
    acting = (1.0 - share) * newer + share * older
    x = np.zeros((frames + 1, 2))
    for t in range(frames):
        acceleration = 20.0 * np.sin(x[t, 0]) - x[t, 1] + 3.0 * acting[t, 0]
        x[t + 1] = x[t] + h * np.array([x[t, 1], acceleration])
    return Rollout(x, u)


@given(st.sampled_from([0.0, 0.5, 1.0, 2.0, 3.0]), st.integers(0, 100))
@settings(max_examples=5, deadline=None)
def test_the_delay_of_motors_comes_back(delay: float, seed: int) -> None:
    study = scratch()
    found = study.identified([late_pendulum(study, delay, 60, seed)]).estimates[0]
    assert found.value == pytest.approx(delay * study.task.time_step)
    assert found.low <= found.value <= found.high


def learned(study: Study, delay: float) -> tuple[Nominal, FittedBias, list[Rollout]]:
    """The identified model and the bias of some experiments, and the experiments."""
    experiments = [late_pendulum(study, delay, 60, seed) for seed in range(3)]
    nominal = study.identified(experiments)
    data = study.select(experiments, nominal).transitions
    return nominal, study.bias.learn(data, experiments, nominal), experiments


def test_a_bias_of_late_inputs_predicts_what_a_bias_of_commands_cannot() -> None:
    study = scratch()
    nominal, bias, experiments = learned(study, 2.0)
    of_commands = study.bias.fit(study.select(experiments, study.nominal).transitions)
    other = late_pendulum(study, 2.0, 60, seed=9)
    windows = Windows.of([other], 10, 1)
    late, commanded = (
        np.sqrt(np.mean((plain([PredictionModel(model)], windows, g)[0] - windows.means) ** 2))
        for model, g in ((nominal, bias), (study.nominal, of_commands))
    )
    assert late < 0.4 * commanded


class Pushed(FittedBias):
    """Changes a rate by the input, in a lane after the other or in all at once."""

    def __init__(self, all_lanes: bool) -> None:
        self.kernel = Kernel(_pushed, np.array([0.1])) if all_lanes else None

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        return self.correction(inputs[:, :2], inputs[:, 2:]), np.zeros((len(inputs), 2))

    def correction(self, x: Array, u: Array) -> Array:
        return np.concatenate([0.0 * u, 0.1 * u], axis=-1)


def _pushed(x, u, data, correction):
    for lane in range(x.shape[1]):
        correction[0, lane], correction[1, lane] = 0.0, data[0] * u[0, lane]


@pytest.mark.parametrize("all_lanes", [False, True])
def test_loops_pass_on_what_acts_as_numpy_does(all_lanes: bool) -> None:
    study, experiments = scratch(), [late_pendulum(scratch(), 1.5, 30)]
    nominal, bias, rng = study.identified(experiments), Pushed(all_lanes), np.random.default_rng(0)
    model = study.model(bias, nominal)
    thetas = rng.uniform(*study.policy.bounds, (3, study.policy.n_parameters))
    starts = np.array([study.task.draw_start(rng) for _ in thetas])
    slow = PlainSimulator([model], [None]).rollouts(thetas, starts, np.zeros(3, int))
    windows, models = Windows.of(experiments, 10, 5), [PredictionModel(nominal)]
    with interpreted():
        assert_alike(simulator(model).rollouts(thetas, starts), slow, rtol=1e-9, atol=1e-9)
        fast = predict(models, windows, bias)
    np.testing.assert_allclose(fast, plain(models, windows, bias), rtol=1e-9, atol=1e-12)


def test_a_model_with_a_delay_of_its_own_is_refused() -> None:
    study = scratch()
    late = study.identified([])
    with pytest.raises(ValueError, match=r"^identification=delay: the nominal model has"):
        study.identification.fit(late, [])


def test_samples_hold_the_inputs_that_acted() -> None:
    study = scratch()
    nominal, _, (first, *_) = learned(study, 2.0)
    acted: Array = nominal.acted_along(first.states[:-1], first.inputs)
    np.testing.assert_array_equal(acted[2:], first.inputs[:-2])
    np.testing.assert_array_equal(acted[:2], 0.0)
