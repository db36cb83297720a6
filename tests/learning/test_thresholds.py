"""Section IV-C: what is learned from, and why the rest is not."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

import simbias
from simbias.core import Nominal
from simbias.core.records import Array, Rollout
from simbias.learning.samples.thresholds import Thresholds, WindowLengths, line_weights
from simbias.trial.study import Study

LIMITS = {"distance": 0.5, "body_angle": 0.3, "board_angle": 0.2, "speed": 2.0}


def rollout_through(study: Study, states: list[list[float]], deviation: float = 0.0) -> Rollout:
    """A made-up experiment: each state is followed by what the nominal model predicts, plus a deviation."""
    rows = []
    for state in states:
        x = np.array(state)
        rows += [x, study.nominal.step(x, np.zeros(1)) + np.array([0, 0, 0, deviation, 0, 0])]
    return Rollout(np.array(rows), np.zeros((len(rows) - 1, 1)))


STATES: list[tuple[list[float], str | None]] = [
    ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], None),
    ([0.0, 0.0, 0.51, 0.0, 0.0, 0.0], "distance"),
    ([0.1, 0.0, 0.21, 0.0, 0.0, 0.0], "body_angle"),
    ([0.21, 0.0, -0.2, 0.0, 0.0, 0.0], "board_angle"),
    ([0.0, 0.0, 0.0, 1.5, 1.5, 0.0], "speed"),
    ([0.0, 0.38, -0.3, 0.0, 0.0, 0.0], "board_angle"),
    ([2.7, -2.7, 0.0, 0.0, 0.0, 0.0], "board_leaves_wheel"),
    ([0.9, 0.0, 0.0, 0.0, 0.0, 0.0], "board_touches_ground"),
]


def test_each_criterion_rejects_and_is_counted(study: Study) -> None:
    samples = Thresholds(study.task, stride=2, limits=LIMITS, residual=0.01)
    for state, criterion in STATES:
        selection = samples.select([rollout_through(study, [state])], study.nominal)
        assert selection.sampled == 1
        rejected = [name for name, count in selection.rejected.items() if count]
        assert rejected == ([criterion] if criterion else [])
        assert len(selection.transitions) == (criterion is None)


def test_a_criterion_of_the_tasks_own_has_another_name(study: Study) -> None:
    for name in ("residual", "other_failure"):
        task = copy(study.task)
        task.criteria = (task.criteria[0]._replace(name=name),)
        with pytest.raises(ValueError, match=f"has a criterion {name}, a name that samples use"):
            Thresholds(task)


def test_outliers_are_rejected_and_a_state_at_a_limit_is_within_it(study: Study) -> None:
    """Criterion 7: the distance from the Lagrangian model's prediction."""
    samples = Thresholds(study.task, stride=2, residual=0.01)
    kept, lost = (
        samples.select([rollout_through(study, [[0.0] * 6], deviation)], study.nominal)
        for deviation in (0.0099, 0.0101)
    )
    np.testing.assert_allclose(kept.transitions.residuals, [[0, 0, 0, 0.0099, 0, 0]], atol=1e-12)
    assert lost.rejected["residual"] == 1
    samples = Thresholds(study.task, stride=1, limits=LIMITS, residual=1.0)
    for angle, rejected in ((0.2, 0), (np.nextafter(0.2, 1.0), 2)):
        states = np.tile([angle, 0.0, -0.2, 0.0, 0.0, 0.0], (3, 1))
        selection = samples.select([Rollout(states, np.zeros((2, 1)))], Still())
        assert selection.rejected["board_angle"] == rejected


def test_residuals_are_equation_6(study: Study) -> None:
    rng = np.random.default_rng(0)
    states, inputs = 0.05 * rng.normal(size=(8, 6)), rng.normal(size=(7, 1))
    samples = Thresholds(study.task, stride=1, residual=10.0)
    transitions = samples.select([Rollout(states, inputs)], study.nominal).transitions
    np.testing.assert_array_equal(transitions.inputs, np.hstack([states[:-1], inputs]))
    for residual, x, u, x_next in zip(transitions.residuals, states, inputs, states[1:], strict=False):
        np.testing.assert_allclose(residual, x_next - study.nominal.step(x, u), rtol=1e-12)


def test_the_failing_contact_is_rejected_by_its_own_criterion(study: Study) -> None:
    """The engine saw the contact end: no state shows it, the rollout's failure does."""
    rollout = rollout_through(study, [[0.0] * 6, [0.0] * 6])
    failed = replace(rollout, failed_at=rollout.frames, failure="board_leaves_wheel")
    selection = Thresholds(study.task, stride=1, residual=1.0).select([failed], study.nominal)
    assert selection.rejected["board_leaves_wheel"] == 1
    assert len(selection.transitions) == rollout.frames - 1
    unsafe = replace(failed, failure="unsafe_rate_of_force")  # no criterion of the task
    others = Thresholds(study.task, stride=1, residual=1.0).select([unsafe], study.nominal)
    assert others.rejected == {**dict.fromkeys(selection.rejected, 0), "other_failure": 1}
    assert others.sampled == len(others.transitions) + 1


# Measured states


class Still(Nominal):
    """Nothing moves: residuals are steps."""

    def step(self, x: Array, u: Array) -> Array:
        return x


def measured(states: Array, inputs: Array | None = None) -> Rollout:
    inputs = np.zeros((len(states) - 1, 1)) if inputs is None else inputs
    return Rollout(states, inputs, measured=states, sensed=True)


def test_weights_are_those_of_the_least_squares_line() -> None:
    for window in (1, 2, 35, 71):
        weights, states = line_weights(window), np.random.default_rng(0).normal(size=window + 1)
        assert weights.sum() == pytest.approx(1)
        assert weights @ np.diff(states) == pytest.approx(np.polyfit(np.arange(window + 1), states, 1)[0])


def test_a_window_finds_an_affine_bias_at_its_mean_state_and_input(study: Study) -> None:
    """However the input jumps."""
    rng, window = np.random.default_rng(0), 71
    bias = 1e-3 * rng.normal(size=(6, 7))
    states, inputs = [0.01 * rng.normal(size=6)], rng.normal(size=(200, 1))
    for u in inputs:
        states.append(study.nominal.step(states[-1], u) + bias @ np.append(states[-1], u))
    samples = Thresholds(study.task, stride=1, residual=1.0, window=WindowLengths(measured=window))
    found = samples.select([measured(np.array(states), inputs)], study.nominal).transitions
    assert len(found) == 200 - window + 1
    np.testing.assert_allclose(found.residuals, found.inputs @ bias.T, rtol=0, atol=1e-12)
    weights = line_weights(window)
    np.testing.assert_allclose(found.inputs[0], [*(weights @ states[:window]), *(weights @ inputs[:window])])


def test_how_many_are_sampled(study: Study) -> None:
    """Only measured states are averaged; an experiment shorter than a window teaches nothing."""
    for stride, expected in ((1, 100), (35, 3), (99, 2), (100, 1), (1000, 1)):
        rollout = Rollout(np.zeros((101, 6)), np.zeros((100, 1)))
        selection = Thresholds(study.task, stride=stride).select([rollout], study.nominal)
        assert (selection.frames, selection.sampled) == (100, expected)
    samples = Thresholds(study.task, stride=10, window=WindowLengths(true_state=1, measured=20))
    for sensed, expected in ((False, 10), (True, 9)):
        rollout = replace(measured(np.zeros((101, 6))), sensed=sensed)
        assert samples.select([rollout], Still()).sampled == expected
    for states, expected in ((71, 0), (72, 1)):
        assert study.samples.select([measured(np.zeros((states, 6)))], study.nominal).sampled == expected
    nothing = study.samples.select([], study.nominal)
    assert nothing.transitions.inputs.shape == (0, 7)
    assert nothing.rejected.keys() == {c.name for c in study.task.criteria} | {"residual"}


def test_windows_recover_the_residual_that_single_steps_lose(study: Study) -> None:
    """Table II's fifth row on the real thing: the error of the residuals against the truth's, in a window."""
    noise = ["hardware.noise.angle_variance=1e-6", "hardware.noise.velocity_variance=1e-3"]
    noisy = simbias.load(["tracking=none", "task.horizon=1500", *noise])
    true = noisy.experiment(np.array([8.1, 4.8, -6.7, -0.4, -5.6]), np.random.default_rng(0))
    for window, least, most in ((1, 5.0, np.inf), (71, 0.0, 0.2)):
        samples = Thresholds(study.task, residual=1e9, window=WindowLengths(window, window))
        truth, seen = (
            samples.select([rollout], study.nominal).transitions.residuals[:, 3:]
            for rollout in (true, replace(true, states=true.measured, sensed=True))
        )
        assert least < np.linalg.norm(seen - truth) / np.linalg.norm(truth) < most, window


# Selection by information


def test_information_chooses_as_many_the_farthest_again_and_again(study: Study) -> None:
    """From the first on, each the farthest from those before it, inputs in units of their limits."""
    rng = np.random.default_rng(1)
    states = np.cumsum(0.01 * rng.normal(size=(41, 6)), axis=0)
    rollouts = [Rollout(states, 2.0 * rng.normal(size=(40, 1)))]
    by_stride, by_information = (
        Thresholds(study.task, stride=4, residual=10.0, selection=selection).select(rollouts, Still())
        for selection in ("stride", "information")
    )
    assert (by_information.sampled, by_information.rejected) == (by_stride.sampled, by_stride.rejected)
    places = np.hstack([states[:-1], rollouts[0].inputs / study.task.input_limit])
    expected = [0]
    while len(expected) < len(by_stride.transitions):
        gaps = [min(np.linalg.norm(place - places[i]) for i in expected) for place in places]
        expected.append(int(np.argmax(gaps)))
    chosen = by_information.transitions.inputs
    np.testing.assert_array_equal(chosen[:, :6], states[sorted(expected)])


def test_information_never_chooses_what_the_criteria_reject(study: Study) -> None:
    states = np.zeros((101, 6))
    states[1::2, 2] = 0.6  # farther than the limit, every other frame
    steady = np.repeat(states[::2], 2, axis=0)[:101] + np.linspace(0, 0.1, 101)[:, None]
    samples = Thresholds(
        study.task, stride=5, limits={"body_angle": 0.5}, residual=1.0, selection="information"
    )
    selection = samples.select([Rollout(each, np.zeros((100, 1))) for each in (states, steady)], Still())
    assert selection.rejected["body_angle"] == len(selection.transitions) == 20
    assert np.abs(selection.transitions.inputs[:, 2]).max() < 0.5
