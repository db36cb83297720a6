"""The delay of motors, known from what states do; biases that are functions of the inputs that act."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interpreted import assert_alike, interpreted

import simbias
from simbias.core import FittedBias, Kernel, Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.bias.window_gp import sensitivities
from simbias.simulation.closed_loop import simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.linearization import advanced
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.simulation.open_loop import PredictionModel, Windows, plain, predict
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

Learned = tuple[Nominal, FittedBias, list[Rollout]]


@pytest.fixture(scope="module")
def study() -> Study:
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
def test_the_delay_of_motors_comes_back(study: Study, delay: float, seed: int) -> None:
    found = study.identified([late_pendulum(study, delay, 60, seed)]).estimates[0]
    assert found.value == pytest.approx(delay * study.task.time_step)
    step = 0.49 * study.task.time_step  # half a frame lies between delays
    assert found.low <= max(0.0, found.value - step)
    assert found.high >= found.value + step


def test_a_delay_beyond_the_longest_is_told(study: Study) -> None:
    """The longest that is considered is 0.06 s, 3 frames."""
    inside, beyond = (study.identified([late_pendulum(study, each, 60)]).oddity() for each in (2.0, 3.5))
    assert inside is None
    assert beyond is not None
    assert beyond[1].endswith("(0.06 s), so the true one may be longer; raise identification.longest")


class Pendulum(Nominal):
    """That of `late_pendulum`, of a torque times `gain`, without a delay."""

    def __init__(self, study: Study, gain: float) -> None:
        self._h, self._gain = study.task.time_step, gain

    def step(self, x: Array, u: Array) -> Array:
        acceleration = 20.0 * np.sin(x[..., 0]) - x[..., 1] + self._gain * 3.0 * u[..., 0]
        return x + self._h * np.stack([x[..., 1], acceleration], axis=-1)


def test_the_delay_comes_back_with_a_model_whose_residuals_depend_on_it(study: Study) -> None:
    """The model may be exact: what is left is noise, which no other delay leaves as small."""
    for gain, delay in product((1.0, 1.2), (0.0, 2.0)):
        exact, rng = late_pendulum(study, delay, 60), np.random.default_rng(0)
        measured = Rollout(exact.states + 1e-3 * rng.standard_normal(exact.states.shape), exact.inputs)
        found = study.identification.fit(Pendulum(study, gain), [measured]).estimates[0]
        assert found.value == pytest.approx(delay * study.task.time_step), gain


def test_where_data_tell_nothing_every_delay_may_be(study: Study) -> None:
    found = study.identified([Rollout(np.zeros((31, 2)), np.zeros((30, 1)))]).estimates[0]
    assert (found.low, found.value) == (0.0, 0.0)
    assert found.high > 0.9 * 0.06


def test_draws_have_the_most_probable_delay_or_any_by_its_probability(study: Study) -> None:
    """Without experiments, any up to the longest is as probable."""
    option = ["identification=delay", "identification.draws=true", "tracking=none"]
    uncertain = simbias.load(["preset=[pendulum_swingup,scratch]", *option])
    x, u, frames, rng = np.zeros((20, 2)), np.eye(20)[:, :1], np.arange(20), np.random.default_rng(0)
    for each, mean in ((study, 0.0), (uncertain, 0.03 / study.task.time_step)):
        model = each.identification.fit(Pendulum(study, 1.0), [])
        responses = np.array([model.draw(rng).along(x, u)[:, 1] for _ in range(300)])
        assert np.mean(responses @ frames / responses.sum(axis=1)) == pytest.approx(mean, abs=0.2)


@pytest.fixture(scope="module")
def learned(study: Study) -> Learned:
    """The identified model and the bias of some experiments, two frames late, and the experiments."""
    experiments = [late_pendulum(study, 2.0, 60, seed) for seed in range(3)]
    nominal = study.identified(experiments)
    data = study.select(experiments, nominal).transitions
    return nominal, study.bias.learn(data, experiments, nominal), experiments


def test_a_bias_of_late_inputs_predicts_what_a_bias_of_commands_cannot(
    study: Study, learned: Learned
) -> None:
    nominal, bias, experiments = learned
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

    def __init__(self, all_lanes: bool, size: float = 0.1) -> None:
        self.kernel, self._size = Kernel(_pushed, np.array([size])) if all_lanes else None, size

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        return self.correction(inputs[:, :2], inputs[:, 2:]), np.zeros((len(inputs), 2))

    def correction(self, x: Array, u: Array) -> Array:
        return np.concatenate([0.0 * u, self._size * u], axis=-1)


def _pushed(x, u, data, correction):
    for lane in range(x.shape[1]):
        correction[0, lane], correction[1, lane] = 0.0, data[0] * u[0, lane]


def test_loops_pass_on_what_acts_as_numpy_does(study: Study) -> None:
    experiments, rng = [late_pendulum(study, 1.5, 30)], np.random.default_rng(0)
    nominal = study.identified(experiments)
    thetas = rng.uniform(*study.policy.bounds, (3, study.policy.n_parameters))
    starts = np.array([study.task.draw_start(rng) for _ in thetas])
    windows, models = Windows.of(experiments, 10, 5), [PredictionModel(nominal)]
    for bias in (Pushed(all_lanes=False), Pushed(all_lanes=True)):
        model = study.model(bias, nominal)
        slow = PlainSimulator([model], [None]).rollouts(thetas, starts, np.zeros(3, int))
        with interpreted():
            assert_alike(simulator(model).rollouts(thetas, starts), slow, rtol=1e-9, atol=1e-9)
            fast = predict(models, windows, bias)
        np.testing.assert_allclose(fast, plain(models, windows, bias), rtol=1e-9, atol=1e-12)


def test_a_model_with_a_delay_of_its_own_is_refused(study: Study) -> None:
    late = study.identified([])
    with pytest.raises(ValueError, match=r"^identification=delay: the nominal model has"):
        study.identification.fit(late, [])


def test_samples_hold_the_inputs_that_acted(study: Study, learned: Learned) -> None:
    nominal, _, (first, *_) = learned
    acted = np.concatenate([np.zeros((2, 1)), first.inputs[:-2]])
    samples = study.select([first], nominal).transitions.inputs
    assert len(samples) > 20
    assert {tuple(row) for row in samples} <= {(*x, *u) for x, u in zip(first.states, acted, strict=False)}
    np.testing.assert_array_equal(Windows.of([first], 10, 5).acted(nominal)[:-1], acted)


def test_parts_of_an_experiment_tell_as_much_of_late_motors_as_the_whole(study: Study) -> None:
    """The inputs that are under way at a cut belong to samples, and to what is known of the delay."""
    whole = late_pendulum(study, 2.0, 60)
    parts = [whole.part(begin, begin + 20) for begin in (0, 20, 40)]
    both = [study.identified(rollouts) for rollouts in ([whole], parts)]
    assert both[0].estimates == both[1].estimates
    selections = [study.select(each, both[0]).transitions for each in ([whole], parts)]
    np.testing.assert_array_equal(selections[0].inputs, selections[1].inputs)
    np.testing.assert_allclose(selections[0].residuals, selections[1].residuals, rtol=1e-12)


def test_what_is_linearised_is_what_acts(study: Study) -> None:
    """Derivatives of predictions by a bias' weights, and of a step, are differences of the plain loop."""
    rng = np.random.default_rng(0)
    experiment = late_pendulum(study, 1.5, 30)
    nominal, windows = study.identified([experiment]), Windows.of([experiment], 6, 2)
    derivatives = sensitivities(nominal, windows, lambda inputs: inputs[:, 2:])  # of one feature, the input
    base, moved = (plain([PredictionModel(nominal)], windows, Pushed(False, size))[0] for size in (0.0, 1e-5))
    np.testing.assert_allclose(1e5 * (moved - base), derivatives[..., 1], rtol=1e-4, atol=1e-7)
    x, memory, u = (rng.standard_normal((5, size)) for size in (2, nominal.state_size, 1))
    after = advanced(nominal, Pushed(False), 2, np.concatenate([x, memory, u], axis=1))
    x_next, kept = nominal.advance(x, u, memory)
    expected = x_next + Pushed(False).correction(x, nominal.acted(u, kept))
    np.testing.assert_allclose(after, np.concatenate([expected, kept], axis=1), rtol=1e-12)


def test_models_keep_what_acts_through_identification_and_draws() -> None:
    study = simbias.load(["identification=posterior", "nominal.sampled=[masses]", "tracking=none"])
    late = simbias.load(["identification=delay", "nominal.sampled=[masses]", "tracking=none"]).identified([])
    assert study.identification.fit(late, []).acting == late.acting != ()
    rng = (np.random.default_rng(1) for _ in range(2))
    x, u = np.full(6, 0.1), np.ones(1)
    np.testing.assert_array_equal(late.draw(next(rng)).step(x, u), study.nominal.draw(next(rng)).step(x, u))


def test_models_whose_biases_see_other_inputs_do_not_run_in_lockstep(study: Study) -> None:
    late = study.identified([])
    commanded = copy(late)
    commanded.acting = ()
    one, same, other = (
        CompiledSimulator.of(study.model(Pushed(False), nominal), None) for nominal in (late, late, commanded)
    )
    same, other = (replace(each, bias=one.bias, policy=one.policy) for each in (same, other))
    assert CompiledSimulator.join([one, same]) is not None
    assert CompiledSimulator.join([one, other]) is None
