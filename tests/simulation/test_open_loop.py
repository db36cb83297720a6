"""Predictions of recorded experiments: compiled against plain, and what they are made of."""

from dataclasses import replace

import numpy as np
import pytest
from interpreted import interpreted, predicted_as_plain
from models import driven

from simbias.core import Kernel, Nominal
from simbias.core.records import Array, Rollout
from simbias.simulation import open_loop
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict
from simbias.trial.study import Study


def experiments(study: Study, lengths: tuple[int, ...] = (37, 8, 64, 3)) -> list[Rollout]:
    """Short records of random states and inputs near the upright pose."""
    rng = np.random.default_rng(0)
    return [
        Rollout(0.1 * rng.standard_normal((k + 1, 6)), 10.0 * rng.standard_normal((k, 1))) for k in lengths
    ]


class Lagging(Nominal):
    """A force that acts through a first-order lag, kept in the memory, on a mass."""

    state_size = 1

    def __init__(self, share: float) -> None:
        self.kernel = Kernel(_lagging, np.array([share]))

    def step(self, x: Array, u: Array) -> Array:
        return self.advance(x, u, u)[0]

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        (share,) = self.kernel.parameters
        force = memory + share * (u - memory)
        velocity = x[..., 1] + 0.01 * force[..., 0]
        return np.stack([x[..., 0] + 0.01 * velocity, velocity], axis=-1), force


def _lagging(x, u, parameters, memory):
    force = memory[0] + parameters[0] * (u[0] - memory[0])
    velocity = x[1] + 0.01 * force
    return (x[0] + 0.01 * velocity, velocity), (force,)


class Integrating(Lagging):
    """A mass whose memory is the integral of its position, which pulls it back."""

    def __init__(self, share: float) -> None:
        self.kernel = Kernel(_integrating, np.array([share]))

    def advance(self, x: Array, u: Array, memory: Array) -> tuple[Array, Array]:
        velocity = x[..., 1] + 0.01 * (u - self.kernel.parameters[0] * memory)[..., 0]
        return np.stack([x[..., 0] + 0.01 * velocity, velocity], axis=-1), memory + x[..., :1]


def _integrating(x, u, parameters, memory):
    velocity = x[1] + 0.01 * (u[0] - parameters[0] * memory[0])
    return (x[0] + 0.01 * velocity, velocity), (memory[0] + x[0],)


def models(study: Study) -> list[PredictionModel]:
    rng = np.random.default_rng(1)
    return [PredictionModel(study.nominal.draw(rng), 0.01 * rng.standard_normal(6)) for _ in range(17)]


def test_written_agrees_with_plain(study: Study) -> None:
    """What is written of an experiment without frames would be beyond the predictions in chunks of one."""
    for windows in (Windows.of(experiments(study), 12, 3), Windows.of(experiments(study, (24, 0)), 12, 1)):
        predicted_as_plain(models(study), windows, 1e-9, 1e-12)


def test_windows_of_one_recording_fill_all_lanes_and_threads(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = list[int]()
    monkeypatch.setattr(open_loop, "in_threads", lambda run, count: counts.append(count))
    predict(models(study)[:2], Windows.of(experiments(study, (64,)), 8, 4))
    assert counts == [2 * 8]


def test_memory_runs_on_where_the_state_is_reset() -> None:
    rng = np.random.default_rng(0)
    rollouts = [Rollout(rng.standard_normal((k + 1, 2)), rng.standard_normal((k, 1))) for k in (50, 23, 41)]
    windows = Windows.of(rollouts, 10, 5)
    models = [PredictionModel(Lagging(share)) for share in (1.0, 0.3, 0.05)]
    short = Windows.of([Rollout(rollouts[0].states[20:31], rollouts[0].inputs[20:30])], 10, 5)
    made, alone = (predicted_as_plain(models, each, 1e-12) for each in (windows, short))
    np.testing.assert_allclose(alone[0, 0], made[0, 2], rtol=1e-12)  # without a lag, all is in x
    assert np.abs(alone[2, 0] - made[2, 2]).max() > 1e-3


def test_where_a_record_continues_its_first_input_was_held() -> None:
    """As if it had lasted before; without an input, or where nothing came before, it stays as it is."""
    rng = np.random.default_rng(0)
    rollout = Rollout(rng.standard_normal((21, 2)), rng.standard_normal((20, 1)))
    both = rollout.states, rollout.inputs
    longer = Rollout(*(np.pad(each, ((1000, 0), (0, 0)), "edge") for each in both))
    models = [PredictionModel(Lagging(share)) for share in (1.0, 0.3, 0.01)]
    within = replace(rollout, continues=True)
    made = predicted_as_plain(models, Windows.of([within], 10, 5), 1e-12)
    np.testing.assert_allclose(made, plain(models, Windows.of([longer], 10, 5))[:, -2:], rtol=1e-3)
    assert Windows.of([rollout], 10, 5).leads == 0
    within.inputs[0] = 0.0
    assert Windows.of([within], 10, 5).leads == 0


def test_parts_of_an_experiment_are_predicted_as_the_whole() -> None:
    """A late motor still has the inputs of before a cut; parts of parts and of what follows a gap, too."""
    rng, models = np.random.default_rng(0), [PredictionModel(Lagging(0.05))]
    for continues in (False, True):
        whole = Rollout(rng.standard_normal((301, 2)), rng.standard_normal((300, 1)), continues=continues)
        cut = [whole.part(0, 100), whole.part(50, 300).part(50, 150), whole.part(200, 300).of_states(2)]
        made = predicted_as_plain(models, Windows.of(cut, 10, 5), 1e-12)
        np.testing.assert_allclose(made, plain(models, Windows.of([whole], 10, 5)), rtol=1e-9)


def test_memory_of_states_is_that_of_the_record() -> None:
    """Not of what was predicted before the state was reset."""
    rng = np.random.default_rng(0)
    windows = Windows.of([Rollout(rng.standard_normal((51, 2)), rng.standard_normal((50, 1)))], 10, 5)
    models = [PredictionModel(Integrating(share)) for share in (1.0, 2.0)]
    predicted_as_plain(models, windows, 1e-12)


def test_a_prediction_is_the_models_steps(study: Study) -> None:
    (rollout,) = experiments(study, (7,))
    windows = Windows.of([rollout], 4, 2)
    states = driven(study.nominal, rollout.states[3], rollout.inputs[3:7])[1:]
    expected = [(states[0] + states[1]) / 2, (states[2] + states[3]) / 2]
    with interpreted():
        (made,) = predict([PredictionModel(study.nominal)], windows)
    np.testing.assert_allclose(made[0], expected, rtol=1e-12)
    np.testing.assert_allclose(windows.means[0, 0], rollout.states[4:6].mean(axis=0), rtol=1e-12)
    none = Windows.of(experiments(study, (3, 0)), 12, 3)  # no whole one
    assert predict([PredictionModel(study.nominal)], none).shape == (1, 0, 4, 6)
