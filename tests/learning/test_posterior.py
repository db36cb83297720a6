"""Identified parameters against the truth that experiments were simulated with."""

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import driven, with_values
from pendulum import NOISE, QUICK, experiment, pendulum, truth

import simbias
from simbias.core import Nominal, Task
from simbias.core.records import Array, Rollout
from simbias.learning.identification.directions import undetermined
from simbias.learning.identification.identified import Identified
from simbias.learning.identification.problem import Problem, WindowErrors
from simbias.learning.identification.refinement import moved_by_shorter_steps
from simbias.learning.measurement_noise import (
    Linearisation,
    MeasurementNoise,
    _moments,
    _moments_of_directions,
)
from simbias.learning.prediction_errors import FREEDOM, ErrorDistribution, correlation_time
from simbias.recordings.study import prepared
from simbias.simulation.open_loop import Windows
from simbias.trial import model_selection
from simbias.trial.model_selection import VARIANTS, log_likelihoods, most_likely
from simbias.trial.steps import ModelVariant, learn
from simbias.trial.study import Study


@pytest.fixture(scope="module")
def study() -> Study:
    return pendulum("identification=posterior", "nominal.uncertainty.bodies=false")  # normal, not cut


@pytest.fixture(scope="module")
def fitted(study: Study) -> tuple[Identified, Rollout]:
    """A model identified from one experiment, and another experiment with that robot."""
    rng = np.random.default_rng(4)
    robot, _ = truth(study.nominal, rng)
    found: Any = study.identification.fit(study.nominal, [experiment(robot, rng, 300)])
    return found, experiment(robot, rng, 300, np.zeros(4))


def prediction_error(nominal: object, rollout: Rollout) -> float:
    return float(np.abs(nominal.step(rollout.states[:-1], rollout.inputs) - rollout.states[1:])[:, 2:].mean())  # type: ignore[attr-defined]


def test_it_predicts_what_it_has_not_seen(study: Study, fitted: tuple[Identified, Rollout]) -> None:
    found, other = fitted
    assert prediction_error(found, other) < 0.25 * prediction_error(study.nominal, other)
    x, u = other.states[5], other.inputs[5]
    np.testing.assert_array_equal(found.advance(x, u, np.empty(0))[0], found.step(x, u))


@pytest.mark.slow
def test_what_shorter_steps_move_is_told() -> None:
    """Of a robot with dry friction, by steps of 10 ms; less by steps of 2 ms, a tenth of a frame.

    Nothing is known of models that have the same frames whatever the task's are, or whole steps of 5 ms. A
    known posterior that is the declared prior changes nothing; a narrow one lets less move.
    """

    def of_whole_steps(study: Study, task: Task) -> Nominal:
        other = copy(task)
        other.time_step = 0.005 * max(1, round(task.time_step / 0.005))
        return study.nominal_of(other)

    quick = ["identification=posterior", *QUICK, "task.time_step=0.02"]
    robot = with_values(pendulum(*quick, "nominal.sub_step=0.0005").nominal, friction_1=0.1, friction_2=0.05)
    recording = [experiment(robot, np.random.default_rng(4), 400, NOISE / [2, 2, 50, 50])]
    moved = dict[float, Array]()
    for step in (0.01, 0.002):
        study = prepared(pendulum(*quick, f"nominal.sub_step={step}"))
        posterior: Any = study.identification
        given = posterior, posterior.fit(study.nominal, recording), recording, ()
        moved[step] = moved_by_shorter_steps(study.task, study.nominal, study.nominal_of, *given)
        prior = Identified.of_prior(study.nominal)
        same, narrow = (
            moved_by_shorter_steps(
                study.task, study.nominal, study.nominal_of, posterior.with_known(known), *given[1:]
            )
            for known in (prior.known, given[1].narrowed(0.1).known)
        )
        assert same == pytest.approx(moved[step], rel=1e-6, abs=1e-9)
        assert narrow.max() < 0.2 * moved[step].max()
        for other in (partial(lambda made, _: made, study.nominal), partial(of_whole_steps, study)):
            assert moved_by_shorter_steps(study.task, study.nominal, other, *given) is None
    assert moved[0.01].max() > 1.5 > moved[0.002].max() > 0.1, moved


def test_draws_are_as_uncertain_as_the_estimates(fitted: tuple[Identified, Rollout]) -> None:
    """Narrowed, they lie nearer to the mode: at half of the distance where the posterior is normal."""
    found, _ = fitted
    draws = [found.draw(np.random.default_rng(i))._values for i in range(300)]  # type: ignore[attr-defined]
    for estimate in found.estimates:
        inside = np.mean([estimate.low <= draw[estimate.name] <= estimate.high for draw in draws])
        assert inside == pytest.approx(0.9, abs=0.06), estimate.name
    narrow = found.narrowed(0.5)
    np.testing.assert_array_equal(narrow.mode, found.mode)
    np.testing.assert_allclose(narrow.covariance, found.covariance / 4, rtol=1e-12)
    for far, near in zip(found.estimates, narrow.estimates, strict=True):
        assert far.low < near.low <= near.value == far.value <= near.high < far.high


def test_without_a_whole_window_or_parameters_it_is_the_model_itself(study: Study) -> None:
    robot, _ = truth(study.nominal, np.random.default_rng(0))
    short = experiment(robot, np.random.default_rng(0), 30)
    fit = study.identification.fit
    assert fit(study.nominal, []) is study.nominal
    assert fit(study.nominal, [short]) is study.nominal
    known = copy(study.nominal)
    known.parameters = ()
    assert fit(known, [experiment(known, np.random.default_rng(0), 300)]) is known


def test_a_robot_at_rest_says_nothing_of_its_parameters(study: Study) -> None:
    """It hangs without torque, whatever they are: the posterior is the prior, exactly."""
    rest = Rollout(np.zeros((201, 4)), np.zeros((200, 2)))
    fitted = study.identification.fit(study.nominal, [rest])
    np.testing.assert_array_equal(fitted.mode, 0.0)
    np.testing.assert_array_equal(fitted.covariance, np.eye(len(fitted.mode)))


@pytest.mark.slow
def test_strong_motion_determines_no_more_than_there_is() -> None:
    """With a heavier second link, its centre nearer, and a first one to match, the robot moves the same.

    Forward differences miss that the values on which it does lie on a curve.
    """
    study = pendulum(*QUICK, "identification.differences=forward", "identification.smoothing=0")
    robot, _ = truth(study.nominal, np.random.default_rng(0))
    u = 10 * np.sin(np.arange(400)[:, None] * np.array([0.03, 0.05]))
    rollout = Rollout(driven(robot, np.array([0.0, 0.0, 20.0, -20.0]), u), u)
    fits = [each.identification.fit(study.nominal, [rollout]) for each in (study, prepared(study))]
    np.testing.assert_allclose(fits[0].mode, fits[1].mode, atol=0.01)
    assert [len(undetermined(fit)) for fit in fits] == [1, 2]
    assert [direction.deviation for direction in undetermined(fits[1])] == pytest.approx([1, 1], abs=0.1)


def test_noise_of_a_robot_that_is_very_unstable_is_found() -> None:
    """Of one direction of a start its predictions tell more, of the other less, than an inverse can hold.

    Where both can be computed they are the same.
    """
    rng, towards = np.random.default_rng(0), np.array([1.0, 0.5])
    growth = np.tile(np.geomspace(1.0, 3e9, 8), (30, 1))[:, :, None]
    starts, noise = 1e-3 * rng.standard_normal((30, 2)), 1e-2 * rng.standard_normal((30, 8))
    for F in (growth * towards, growth**0.1 * rng.standard_normal((30, 8, 2))):
        errors = np.einsum("wdn,wn->wd", F, starts) + noise
        linearisation = Linearisation(F, np.zeros((30, 8, 1)))
        noise_found = MeasurementNoise.of(errors, np.ones(30), linearisation, np.full(8, 1e-9))
        covariance = noise_found.covariance(linearisation)
        assert np.isfinite(covariance).all()
        assert 0.4 < covariance[-1, -1] / np.mean(errors[:, -1] ** 2) < 2.5
    moments_of = F, errors[:, :, None], np.array([1e-6, 2e-6]), np.linspace(1e-4, 2e-4, 8)
    for ours, theirs in zip(_moments(*moments_of), _moments_of_directions(*moments_of), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)


@given(seed=st.integers(0, 1000))
def test_the_spread_knows_windows_in_which_noise_has_more_effect(seed: int) -> None:
    """The covariance of scores times errors is at most that of average windows and the excess.

    Where noise has the same effect in all windows there is no excess.
    """
    rng, w, d, n, p = np.random.default_rng(seed), 50, 6, 2, 3
    F, scores = rng.standard_normal((w, d, n)), rng.standard_normal((p, w, d))
    F[rng.permutation(w)[:5]] *= 10.0
    spread, noise = rng.standard_normal((p, p)), MeasurementNoise(np.array([1.0, 4.0]), np.ones(n))
    same = np.tile(F[:1], (w, 1, 1))
    for effects, some in ((F, True), (same, False)):
        linearisation = Linearisation(effects, np.zeros((w, d, 1)))
        root = noise.excess(scores, np.ones(w), linearisation, spread)
        excess = spread.T @ root @ root.T @ spread
        own = np.einsum("pwd,wdn->pwn", scores, effects * [1.0, 2.0]).reshape(p, -1)
        average = np.einsum("pwd,de,qwe->pq", scores, noise.covariance(linearisation) - np.eye(d), scores)
        missing = spread.T @ (own @ own.T - average) @ spread
        size = np.abs(spread.T @ own @ own.T @ spread).max()
        assert np.linalg.eigvalsh(excess - missing).min() > -1e-9 * size
        assert (np.linalg.eigvalsh(missing).max() > 1e-9 * size) == (excess.max() > 1e-9 * size)
        assert some or excess.max() < 1e-9 * size


@pytest.mark.slow
def test_what_is_declared_is_found_again_where_far_too_much_may_be() -> None:
    """Joints without friction; a hundred times as much as is usual would be in the prior's midst."""
    careless = {"damping": 2.0, "friction": 20.0, "rotor_inertia": 0.1}
    study = pendulum(*QUICK, *[f"nominal.uncertainty.{name}={spread}" for name, spread in careless.items()])
    found = study.identification.fit(
        study.nominal, [experiment(study.nominal, np.random.default_rng(4), 400)]
    )
    for estimate in found.estimates:
        spread = next((each for name, each in careless.items() if estimate.name.startswith(name)), None)
        if spread:
            assert estimate.value < 1e-3 * spread, estimate.name
        else:
            assert estimate.low < estimate.declared < estimate.high, estimate.name


@pytest.mark.slow
def test_an_outlier_counts_little_and_a_fall_not_at_all(study: Study) -> None:
    """A blow that no model knows, in one window; experiments that end by a failure count as others."""
    rng = np.random.default_rng(2)
    robot, _ = truth(study.nominal, rng)
    clean = experiment(robot, rng, 300)
    hit = clean.states.copy()
    hit[210:] += np.array([0.3, 0.3, 5.0, 5.0])
    fallen = replace(clean, failed_at=clean.frames, failure="speed")
    records = (clean, fallen, Rollout(hit, clean.inputs))
    one, same, struck = (study.identification.fit(study.nominal, [each]) for each in records)
    assert one.estimates == same.estimates
    other = experiment(robot, rng, 200, np.zeros(4))
    assert prediction_error(one, other) < 0.3 * prediction_error(study.nominal, other)
    assert prediction_error(struck, other) < 0.3 * prediction_error(study.nominal, other)


@pytest.mark.slow
def test_the_posterior_covers_the_truth() -> None:
    """Ranks of true parameters in their posteriors are uniform, as far as 12 robots tell."""
    from scipy.stats import kstest  # lazily: it takes a second

    study, ranks = pendulum(*QUICK, "nominal.uncertainty.bodies=false"), []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        robot, values = truth(study.nominal, rng)
        fitted = study.identification.fit(study.nominal, [experiment(robot, rng, 200)])
        draws = [fitted.draw(np.random.default_rng(i))._values for i in range(99)]  # type: ignore[attr-defined]
        names = [parameter.name for parameter in fitted.parameters]
        ranks.append(np.mean([[draw[name] for name in names] < values for draw in draws], axis=0))
    every = np.array(ranks)
    assert 0.82 < np.mean((every > 0.05) & (every < 0.95)) < 0.98
    assert kstest(every.ravel(), "uniform").statistic < 0.14


@pytest.mark.slow
def test_windows_that_count_twice_tell_nothing_more(study: Study) -> None:
    """The same windows twice have the likelihood of once; of two durations each window counts alike."""
    robot, _ = truth(study.nominal, np.random.default_rng(0))
    rollout, z = experiment(robot, np.random.default_rng(0), 300), np.zeros(11)
    short, long = Windows.of([rollout], 50, 5), Windows.of([rollout], 100, 10)
    once, twice, both = (
        Problem(study.nominal, each, z, FREEDOM) for each in ([short], [short, short], [short, long])
    )
    np.testing.assert_allclose(twice.precision(z), once.precision(z), rtol=1e-9)
    np.testing.assert_allclose(
        twice.spread(z) @ twice.spread(z).T, once.spread(z) @ once.spread(z).T, rtol=1e-6
    )
    apart = [Problem(study.nominal, [each], z, FREEDOM).precision(z) - np.eye(11) for each in (short, long)]
    np.testing.assert_allclose(both.precision(z) - np.eye(11), (2 * apart[0] + apart[1]) / 3, rtol=1e-9)
    np.testing.assert_allclose(twice.mode(z, 2), once.mode(z, 2), rtol=1e-6)


@pytest.mark.slow
def test_the_posterior_is_that_of_markov_chains(study: Study) -> None:
    """The density's normal approximation against walkers, which use neither derivatives nor normality."""
    rng = np.random.default_rng(7)
    robot, _ = truth(study.nominal, rng)
    rollout = experiment(robot, rng, 300)
    fitted = study.identification.fit(study.nominal, [rollout])
    windows = study.identification.windows([rollout])  # type: ignore[attr-defined]
    comparison = WindowErrors.at(study.nominal, windows, fitted.mode, FREEDOM)

    def log_densities(z: Array) -> Array:
        losses = comparison.errors.losses(comparison.errors.whiten(comparison.prediction_errors(z)))
        return -0.5 * (np.sum(z**2, axis=1) + comparison.errors.independent_share * losses.sum(axis=1))

    covariance = np.linalg.inv(Problem(study.nominal, [windows], fitted.mode, FREEDOM).precision(fitted.mode))
    z = walk(log_densities, fitted.mode, covariance, rng)
    deviations = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(z.mean(axis=0) - fitted.mode) < 0.5 * deviations)
    np.testing.assert_allclose(np.std(z, axis=0), deviations, rtol=0.35)
    within = np.abs(z - fitted.mode) < 1.645 * deviations
    assert 0.85 < within.mean() < 0.95


def walk(
    log_densities: Callable[[Array], Array],
    start: Array,
    covariance: Array,
    rng: np.random.Generator,
    walkers: int = 64,
    steps: int = 360,
) -> Array:
    """Draws by stretch moves of an ensemble, from a wide start (J. Goodman and J. Weare, 2010)."""
    p, half = len(start), walkers // 2
    z = start + 2.0 * rng.standard_normal((walkers, p)) @ np.linalg.cholesky(covariance).T
    values, kept = log_densities(z), []
    for step in range(steps):
        for own, others in ((slice(half), slice(half, None)), (slice(half, None), slice(half))):
            stretch = (1.0 + rng.random(half)) ** 2 / 2.0
            others_z = z[others][rng.integers(half, size=half)]
            proposed = others_z + stretch[:, None] * (z[own] - others_z)
            there = log_densities(proposed)
            chance = (p - 1) * np.log(stretch) + there - values[own]
            moved = np.log(rng.random(half)) < chance
            z[own] = np.where(moved[:, None], proposed, z[own])
            values[own] = np.where(moved, there, values[own])
        if step >= steps // 3:
            kept.append(z.copy())
    return np.concatenate(kept)


def test_the_share_of_new_windows() -> None:
    """1 of independent errors, (1 - a) / (1 + a) of errors that keep a of the error before."""
    rng, a = np.random.default_rng(0), 0.8
    e = rng.standard_normal((4000, 5))
    same = np.zeros(4000, np.int64)
    assert correlation_time(e, same) == pytest.approx(1.0, abs=0.15)
    for t in range(1, len(e)):
        e[t] = a * e[t - 1] + np.sqrt(1 - a * a) * e[t]
    assert correlation_time(e, same) == pytest.approx((1 + a) / (1 - a), rel=0.25)


def test_windows_at_rest_say_nothing_of_errors_in_motion() -> None:
    """Three quarters of the windows are an encoder's that stands still, as interpolation leaves it."""
    rng = np.random.default_rng(0)
    states = np.cumsum(rng.standard_normal((101, 2)), axis=0)
    rest = states[-1] * (1.0 + 1e-15 * rng.standard_normal((300, 2)))
    inputs = np.zeros((400, 1))
    whole = Windows.of([Rollout(np.concatenate([states, rest]), inputs)], 10, 5)
    moving = Windows.of([Rollout(states, inputs[:100])], 10, 5)
    e = np.concatenate([rng.standard_normal((10, 2, 2)), np.zeros((30, 2, 2))])
    with_rest, without = ErrorDistribution.of(e, whole), ErrorDistribution.of(e[:10], moving)
    np.testing.assert_allclose(with_rest.factor, without.factor, rtol=1e-6)
    assert with_rest.independent_share == pytest.approx(without.independent_share, rel=1e-6)
    still = Windows.of([Rollout(rest, inputs[:299])], 10, 5)
    assert still.moving.all()


def test_likelihood_is_students() -> None:
    """Against SciPy's density, at the estimated scale."""
    from scipy.stats import multivariate_t

    rng = np.random.default_rng(0)
    rollout = Rollout(rng.standard_normal((401, 2)), rng.standard_normal((400, 1)))
    windows = Windows.of([rollout], 10, 5)
    e = rng.standard_normal((40, 2, 2))
    errors = ErrorDistribution.of(e, windows)
    exact = multivariate_t(np.zeros(4), errors.factor @ errors.factor.T, df=4 * FREEDOM)
    np.testing.assert_allclose(errors.log_likelihoods(e), exact.logpdf(e.reshape(40, 4)), rtol=1e-9)


@pytest.mark.slow
def test_model_selection_prefers_what_predicts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrong masses and friction: identified parameters. Nothing is left for a bias, which is then none.

    The margin is taken off the gain of what is less simple; by one standard error, the declared model is
    kept where it is true.
    """
    known, errors = {}, model_selection._errors
    study, rng = pendulum(*QUICK, "bias=none"), np.random.default_rng(5)

    def once(study: Study, variant: ModelVariant, kept: list[Rollout], left_out: Windows) -> Array:
        key = (variant, *map(id, kept))  # no margin changes the fits
        if key not in known:
            known[key] = errors(study, variant, kept, left_out)
        return known[key]

    monkeypatch.setattr(model_selection, "_errors", once)
    rollouts = [experiment(truth(study.nominal, np.random.default_rng(5))[0], rng, 120) for _ in range(3)]
    without, one, two = (log_likelihoods(study, rollouts, margin) for margin in (0.0, 1.0, 2.0))
    assert list(without) == list(VARIANTS)
    first, second = "declared models", "identified parameters"
    assert without[second] > without[first] + 5
    assert without[first] == one[first] == two[first]
    error = without[second] - one[second]
    assert 0.1 < error < 30.0  # nats
    assert two[second] == pytest.approx(without[second] - 2 * error)
    assert most_likely(one).identifies
    assert learn(study, rollouts, [rollouts], most_likely(one)).model.nominal.estimates
    right = [experiment(study.nominal, rng, 100) for _ in range(3)]
    assert not most_likely(log_likelihoods(study, right, margin=1.0)).identifies
    assert log_likelihoods(study, [experiment(study.nominal, rng, 30)]) == {}
    assert most_likely({}) == VARIANTS["parameters and residual"]


@pytest.mark.slow
def test_lag_and_delay_of_the_bongoboard_are_identified() -> None:
    """Hidden states: simulated from the commands, through measured states."""
    spreads = {"lag": 0.02, "delay": 0.02, "motor_gain": 0.3}
    uncertain = [f"nominal.uncertainty.{name}={value}" for name, value in spreads.items()]
    study = simbias.load(["tracking=none", *QUICK, "identification.starts=2", *uncertain])
    true = {"lag": 0.015, "delay": 0.008, "motor_gain": 0.8, "foot_mass": 0.5}
    robot, rng, rollouts = with_values(study.nominal, **true), np.random.default_rng(0), []
    for _ in range(4):
        start, u = study.task.draw_start(rng), np.repeat(20.0 * rng.standard_normal((15, 1)), 40, axis=0)
        noise = np.array([1e-3] * 3 + [0.03] * 3) * rng.standard_normal((len(u) + 1, 6))
        measured = driven(robot, start, u) + noise
        rollouts.append(Rollout(measured, u, sensed=True))
    fitted = study.identification.fit(study.nominal, rollouts)
    found = {estimate.name: estimate.value for estimate in fitted.estimates}
    assert found["lag"] == pytest.approx(0.015, abs=0.002)
    assert found["delay"] == pytest.approx(0.008, abs=0.002)
