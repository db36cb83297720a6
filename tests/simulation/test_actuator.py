"""What lies between a command and what acts, against the theory of lags and delays; and in closed loops."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interpreted import assert_alike, interpreted

import simbias
from simbias.core import Nominal
from simbias.core.records import Array
from simbias.simulation.actuator import Actuator, Actuators, taps_of
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.study import Study

DT = 0.001
actuators = st.builds(
    Actuator,
    gain=st.floats(0.1, 2.0),
    offset=st.floats(-1.0, 1.0),
    limit=st.floats(0.5, 5.0),
    lag=st.sampled_from([0.0, 0.002, 0.03]),
    delay=st.floats(0.0, 0.005),
)


def responses(actuators: Actuators, inputs: Array) -> Array:
    """What acts (k, m) of inputs (k, m)."""
    memory, acts = np.zeros(actuators.state_size), []
    for u in inputs:
        acting, memory = actuators.acting(u, memory)
        acts.append(acting)
    return np.array(acts)


def response(actuator: Actuator, u: Array, taps: int = 5, averaged: bool = False) -> Array:
    """What acts (k,) of inputs (k,)."""
    return responses(Actuators([actuator], DT, taps, averaged), u[:, None])[:, 0]


def test_by_default_it_acts_as_commanded_else_with_gain_limit_and_offset() -> None:
    u = np.random.default_rng(0).normal(size=50)
    for taps in (5, 0):
        np.testing.assert_array_equal(response(Actuator(), u, taps), u)
    acts = response(Actuator(gain=0.5, offset=1.0, limit=2.0), np.array([1.0, -3.0, 100.0, -100.0]))
    np.testing.assert_allclose(acts, [1.5, -0.5, 3.0, -1.0])


def test_a_delay_of_whole_frames_is_exact_and_of_part_of_one_between_them() -> None:
    u = np.random.default_rng(0).normal(size=50)
    acts = {frames: response(Actuator(delay=frames * DT), u) for frames in (0, 1, 2, 2.25, 3, 5)}
    for frames in (0, 1, 3, 5):
        np.testing.assert_array_equal(acts[frames], np.concatenate([np.zeros(frames), u])[:50])
    np.testing.assert_allclose(acts[2.25], 0.75 * acts[2] + 0.25 * acts[3], atol=1e-12)
    assert [taps_of(delay, DT) for delay in (0.0, 0.003, 0.0031)] == [0, 3, 4]


def test_a_lag_answers_a_step_with_an_exponential() -> None:
    acts = response(Actuator(lag=0.02), np.ones(100))
    np.testing.assert_allclose(acts, 1.0 - np.exp(-DT * np.arange(1, 101) / 0.02), rtol=1e-12)


@pytest.mark.slow
def test_over_a_frame_an_averaged_lag_acts_by_its_mean() -> None:
    """That of a lag that is simulated in a thousandth of a frame; without a lag, the input itself."""
    u, fine, lag = np.random.default_rng(0).normal(size=40), 500, 0.002
    finely = Actuators([Actuator(lag=lag)], DT / fine, 0)
    for late in (0, 150, 1250):
        delayed = np.concatenate([np.zeros(late), np.repeat(u, fine)])[: fine * len(u), None]
        means = responses(finely, delayed)[:, 0].reshape(-1, fine).mean(axis=1)
        averaged = response(Actuator(lag=lag, delay=late / fine * DT), u, averaged=True)
        np.testing.assert_allclose(averaged, means, atol=2e-3)
    np.testing.assert_array_equal(response(Actuator(), u, averaged=True), u)


@given(actuator=actuators, u=st.floats(-10.0, 10.0))
@settings(deadline=None, max_examples=10)
def test_it_settles_where_it_is_said_to(actuator: Actuator, u: float) -> None:
    settled = Actuators([actuator], DT, 5).settled(np.array([u]))[0]
    assert response(actuator, np.full(1000, u))[-1] == pytest.approx(settled, rel=1e-9, abs=1e-9)


@given(both=st.tuples(actuators, actuators), seed=st.integers(0, 100), averaged=st.booleans())
@settings(deadline=None, max_examples=10)
def test_two_inputs_have_their_own_and_the_memory_of_a_record_is_that_of_the_loop(
    both: tuple[Actuator, Actuator], seed: int, averaged: bool
) -> None:
    inputs = np.random.default_rng(seed).normal(scale=3.0, size=(30, 2))
    together = Actuators(both, DT, 5, averaged)
    memories = together.model_states(inputs)
    acts, after = together.acting(inputs, memories)
    np.testing.assert_allclose(acts, responses(together, inputs), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(after[:-1], memories[1:], rtol=1e-12, atol=1e-12)
    assert together.model_states(inputs[:0]).shape == (0, together.state_size)  # of a fall at the start
    for i, actuator in enumerate(both):
        alone = response(actuator, inputs[:, i], averaged=averaged)
        np.testing.assert_allclose(acts[:, i], alone, rtol=1e-12, atol=1e-12)


# In closed loops

MOTOR = {"motor_gain": 0.3, "lag": 0.01, "delay": 0.004, "torque_limit": 60.0, "slope": 0.02}


@pytest.fixture(scope="module")
def driven() -> Study:
    """A study whose nominal model has an uncertain motor."""
    uncertainty = [f"nominal.uncertainty.{name}={spread}" for name, spread in MOTOR.items()]
    return simbias.load(["tracking=none", "bias=none", "task.horizon=150", *uncertainty])


@pytest.mark.slow
def test_models_with_memory_run_in_lanes_as_in_numpy(driven: Study) -> None:
    """In several scenarios, some rollouts taking the places of others that ended."""
    rng, model = np.random.default_rng(0), driven.model()
    models = [replace(model, nominal=driven.nominal.draw(rng)) for _ in range(3)]
    fast = join([simulator(each, cost=driven.cost) for each in models])
    assert isinstance(fast, CompiledSimulator)
    scenarios, thetas = rng.integers(0, 3, 24), rng.uniform(-5, 5, (24, 5))
    starts = np.array([driven.task.draw_start(rng) for _ in thetas])
    with interpreted():
        together = fast.rollouts(thetas, starts, scenarios)
    expected = PlainSimulator(models, [None] * 3).rollouts(thetas, starts, scenarios)
    assert len({rollout.frames for rollout in together}) > 3
    assert_alike(together, expected, 1e-6, 1e-9)


def test_a_recorded_rollout_is_predicted_with_what_it_hides(driven: Study, uncompiled: None) -> None:
    """Frame by frame to rounding, where the same step without memory is wrong."""
    nominal = driven.nominal.draw(np.random.default_rng(1))
    rollout = driven.simulate(np.array([3.0, 2.0, -3.0, -2.0, 1.0]), nominal=nominal)
    assert rollout.frames > 50
    before, after = rollout.states[:-1], rollout.states[1:]
    np.testing.assert_allclose(nominal.along(before, rollout.inputs), after, atol=1e-10)
    assert np.abs(nominal.step(before, rollout.inputs) - after).max() > 1e-3
    memories = Nominal.model_states(nominal, before, rollout.inputs)
    np.testing.assert_allclose(nominal.model_states(before, rollout.inputs), memories, atol=1e-9)
    assert driven.samples.select([rollout], nominal).transitions.residuals == pytest.approx(0.0, abs=1e-9)
