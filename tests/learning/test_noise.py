"""Noise of recorded states, which is added to known ones, and states without most of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pendulum import QUICK, experiment, pendulum

from simbias.core.parameters import values_at
from simbias.core.records import Array, Rollout
from simbias.learning.identification.identified import Identified
from simbias.learning.noise import OUTLIER, noise_of, smoothed, white_noise
from simbias.recordings.study import prepared


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.parametrize("every", [1.0, 2.5, 10.0])
def test_noise_is_that_which_was_added_to_samples(every: float, jitter: float) -> None:
    """Of two runs, the times of which may be uneven."""
    rng = np.random.default_rng(0)
    t = every * (np.arange(2000.0) + jitter * rng.uniform(-1, 1, 2000))
    values = np.sin(0.008 * t) + 0.01 * rng.standard_normal(len(t))
    runs = [(t[part], values[part]) for part in (slice(0, 900), slice(1000, 2000))]
    assert white_noise(runs) == pytest.approx(0.01, rel=0.1)
    assert white_noise([(t[:3], values[:3])]) == 0.0
    fast = np.sin(0.5 * t / every) + 0.01 * rng.standard_normal(
        len(t)
    )  # third differences are 2.7 times as large
    assert white_noise([(t, fast)]) == pytest.approx(0.01, rel=0.1 + jitter)


def test_noise_of_rollouts_is_known_or_estimated_in_their_frames() -> None:
    """Known noise is averaged over frames."""
    states = np.random.default_rng(0).standard_normal((4000, 2)) * [0.01, 3.0]
    rollout = Rollout(states, states[:-1])
    np.testing.assert_allclose(noise_of([rollout]), [0.01, 3.0], rtol=0.1)
    short = rollout.part(0, 999)
    known = [replace(each, noise=np.array(noise)) for each, noise in ((rollout, [1.0, 2]), (short, [1, 7]))]
    np.testing.assert_allclose(noise_of(known), [1.0, (0.8 * 2**2 + 0.2 * 7**2) ** 0.5])
    assert noise_of([known[1].of_states(1)]) == [1.0]


def test_steps_of_an_encoder_are_noise_also_where_it_mostly_rests() -> None:
    """About a step over the root of 12; they are no rare samples. What never moves has none."""
    values = np.round(40 * np.sin(0.004 * np.arange(5000.0)))
    assert (np.diff(values) == 0).mean() > 0.8
    states = np.column_stack([values, np.ones(5000)])
    moving, still = noise_of([Rollout(states, states[:-1])])
    assert 12**-0.5 / 2 < moving < 2 * 12**-0.5
    assert still == 0


def recorded(*states: Array) -> Rollout:
    x = np.column_stack(states)
    return Rollout(x, x[:-1], sensed=True)


def test_smoothed_states_are_nearer_to_the_motion_than_recorded_ones() -> None:
    """White noise falls to less than half; true states stay, as noise that a policy feeds back moved them."""
    rng, t = np.random.default_rng(0), 0.01 * np.arange(2000.0)
    motion = np.column_stack([np.sin(3 * t), 3 * np.cos(3 * t)])
    noisy = motion + np.array([0.01, 0.3]) * rng.standard_normal(motion.shape)
    smooth, true = smoothed([recorded(noisy), Rollout(noisy, noisy[:-1])], 10)
    assert (np.std(smooth - motion, axis=0) < 0.5 * np.array([0.01, 0.3])).all()
    np.testing.assert_array_equal(true, noisy)
    np.testing.assert_array_equal(smoothed([recorded(noisy)], 0)[0], noisy)


@pytest.mark.parametrize("jump", [0.4, 0.05])
@pytest.mark.parametrize(("frames", "kept"), [(1190, True), (1195, False)])
def test_states_stay_as_recorded_where_inputs_jump_when_predictions_begin(
    frames: int, kept: bool, jump: float
) -> None:
    """Also small jumps, whose bend is less than the noise; but not if inputs jump in between."""
    rng, noise = np.random.default_rng(0), 0.1 if jump > 0.1 else 0.03
    inputs = np.repeat(rng.choice([-jump, jump], 120), 10)[:frames]
    velocity = np.cumsum(np.append(0.0, inputs))
    measured = (velocity + noise * rng.standard_normal(frames + 1))[:, None]
    rollout = Rollout(measured, inputs[:, None], sensed=True)
    (smooth,), (guarded,) = smoothed([rollout], 5), smoothed([rollout], 5, 10)
    assert not (smooth == measured).all()
    np.testing.assert_array_equal(guarded, measured if kept else smooth)


def test_noise_that_a_policy_feeds_back_does_not_prevent_smoothing() -> None:
    """Inputs then jump with the noise of the frame where a prediction begins."""
    rng, x, states, inputs = np.random.default_rng(0), np.array([0.0, 0.0]), [], []
    for k in range(2000):
        states.append(x + [0.0, 0.1] * rng.standard_normal(2))
        inputs.append([3 * np.sin(0.02 * k) - states[-1] @ [4.0, 2.0]])
        x = x + 0.01 * np.array([x[1], inputs[-1][0]])
    rollout = Rollout(np.array([*states, x]), np.array(inputs), sensed=True)
    assert np.std(smoothed([rollout], 5, 10)[0][:, 1] - rollout.states[:, 1]) > 0.05


def test_motion_without_noise_stays() -> None:
    """To less than a millionth; and so does a state that rests, and what is too short to be smoothed."""
    t = 0.01 * np.arange(500.0)
    exact = recorded(np.sin(4 * t) + 0.2 * np.sin(19 * t), np.zeros(500))
    np.testing.assert_allclose(smoothed([exact], 10)[0], exact.states, rtol=0, atol=1e-6)
    short = recorded(np.random.default_rng(0).standard_normal(6))
    np.testing.assert_array_equal(smoothed([short], 10)[0], short.states)


@pytest.mark.slow
@given(at=st.integers(40, 160), jump=st.floats(1.0, 1e3))
@settings(deadline=None)
def test_a_collision_stays_where_it_is(at: int, jump: float) -> None:
    """A velocity that jumps in one frame is moved by no more than its noise, nor in other recordings."""
    noise = 0.01 * np.random.default_rng(at).standard_normal(200)
    struck, other = recorded(np.where(np.arange(200) < at, 0.0, jump) + noise), recorded(noise)
    for rollout, smooth in zip([struck, other], smoothed([struck, other], 8), strict=True):
        assert np.abs(smooth - rollout.states).max() < OUTLIER * 0.02


@pytest.mark.slow
def test_predictions_that_begin_smoothed_tell_more() -> None:
    """Of what noisy velocities blur, errors and told deviations are smaller, and true values are held."""
    quicker = [*QUICK, "identification.starts=2"]
    study = prepared(pendulum(*quicker, "nominal.uncertainty.bodies=false"))
    identifications = [pendulum(*quicker, "identification.smoothing=0").identification, study.identification]
    names = [parameter.name for parameter in study.nominal.parameters]
    told = [names.index(name) for name in ("inertia_2", "damping_1", "damping_2", "friction_1", "friction_2")]
    wrong, deviations = np.empty((2, 2, 8, len(told)))
    for k in range(8):
        rng = np.random.default_rng(k)
        z = 0.5 * rng.standard_normal(len(names))
        robot = study.nominal.with_parameters(values_at(study.nominal.parameters, z))
        rollouts = [experiment(robot, rng, noise=np.array([1e-3, 1e-3, 0.1, 0.1])) for _ in range(2)]
        for i, identification in enumerate(identifications):
            fitted = identification.fit(study.nominal, rollouts)
            assert isinstance(fitted, Identified)
            wrong[i, k] = (fitted.mode - z)[told]
            deviations[i, k] = np.sqrt(np.diag(fitted.covariance))[told]
    errors = np.sqrt(np.mean(wrong**2, axis=1))
    for measured, smooth in (errors, deviations.mean(axis=1)):
        assert np.exp(np.mean(np.log(smooth / measured))) < 0.85
    assert np.mean(np.abs(wrong[1]) < 1.645 * deviations[1]) > 0.75
