"""Section IV-B to IV-D against scikit-learn and limits that theory gives; and through inducing points."""

import warnings
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_lanes import corrections
from point_mass import PointMass

import simbias
from simbias.config import ConfigError
from simbias.config.build import build
from simbias.core import StudyWarning
from simbias.core.records import Array, Transitions
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.bias.inducing import Inducing, choose
from simbias.learning.bias.lscde import LeastSquaresDensity
from simbias.learning.bias.none import ZeroBias
from simbias.learning.bias.posterior import exact
from simbias.learning.covariance import Hyperparameters, correlation, stable_cholesky
from simbias.learning.identification.delay import Delay
from simbias.simulation.compiler import LANES, compile_closed_loop
from simbias.sweep.worker import PlannedTrial, run_plan
from simbias.terminal.study_warnings import warnings_in_one_line
from simbias.testing.studies import warm_up
from simbias.trial.study import Study

SCALE = np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0, 30.0])  # of plausible states and torques


def data(n: int, seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    return Transitions(rng.normal(size=(n, 7)) * SCALE, rng.normal(size=(n, 6)) * 1e-3)


def queries(k: int) -> Array:
    return np.random.default_rng(99).normal(size=(k, 7)) * SCALE


@pytest.mark.slow
def test_agrees_with_scikit_learn(study: Study) -> None:
    """Without a linear function, and with one, whose inputs are from the data's mean."""
    from sklearn.gaussian_process import GaussianProcessRegressor  # lazily: it takes seconds
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

    lengths, scale = [0.5, 1, 1, 2, 1, 1, 0.7], np.array([1, 1, 1, 1, 1, 1, 100])
    inputs = queries(200)
    for n, linear in product((1, 50, 571), (0.0, 2.0)):
        transitions = data(n)
        gp = GaussianProcess(study.task, length_scale=lengths, signal_variance=1.3, linear=linear)
        mean, variance = gp.fit(transitions).predict(inputs)
        kernel = ConstantKernel(1.3) * RBF(lengths) + WhiteKernel(np.exp(-4))
        centre = transitions.inputs.mean(axis=0) if linear else 0.0
        if linear:
            kernel += ConstantKernel(linear**2) * DotProduct(1.0)
        reference = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None)
        reference.fit((transitions.inputs - centre) / scale, transitions.residuals)
        their_mean, their_deviation = reference.predict((inputs - centre) / scale, return_std=True)
        np.testing.assert_allclose(mean, their_mean, rtol=0, atol=1e-8)
        relative = variance / np.mean(transitions.residuals**2, axis=0)
        np.testing.assert_allclose(relative, their_deviation**2, rtol=0, atol=1e-8)


def test_correction_is_equation_7(study: Study) -> None:
    gp = GaussianProcess(study.task, d=0.3)
    transitions, x = data(100), queries(1)[0]
    fitted = gp.fit(transitions)
    mean, variance = fitted.predict(x[None])
    sigma = np.sqrt(variance[0] / np.mean(transitions.residuals**2, axis=0))
    expected = np.exp(-0.3 * np.linalg.norm(sigma) ** 2) * mean[0]
    np.testing.assert_allclose(fitted.correction(x[:6], x[6:]), expected, rtol=1e-12)


def test_far_from_the_data_it_is_the_linear_function(study: Study) -> None:
    """Which has no weight in Eq. 7; without data it is zero."""
    bias, slopes = GaussianProcess(study.task, linear=10.0), np.linspace(-1e-3, 1e-3, 42).reshape(7, 6)
    near, far = data(100).inputs, 30 * queries(5)
    fitted = bias.fit(Transitions(near, 2e-3 + near @ slopes))
    np.testing.assert_allclose(
        fitted.correction(far[:, :6], far[:, 6:]), 2e-3 + far @ slopes, rtol=0.02, atol=1e-4
    )
    nothing = bias.fit(data(0))
    for each in (nothing, nothing.draw(np.random.default_rng(0))):
        assert not each.correction(far[:, :6], far[:, 6:]).any()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::simbias.core.StudyWarning")
def test_kernel_agrees_with_plain_correction(study: Study) -> None:
    """Single precision: 1e-6, of sums of 1200 terms whose sizes add up to 20 (residuals here are random)."""
    for n, linear in ((1, 0.0), (2, 0.0), (3, 1.0), (5, 0.0), (97, 0.0), (97, 1.0), (1200, 0.0)):
        fitted = GaussianProcess(study.task, d=0.1, linear=linear).fit(data(n))
        inputs = queries(LANES)
        plain = fitted.correction(inputs[:, :6], inputs[:, 6:])
        np.testing.assert_allclose(corrections(fitted, inputs), plain, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_far_from_zero_it_is_the_same(study: Study) -> None:
    """At 1e4 length scales the compiled one would lose four digits in single precision."""
    near, away = data(97), 2e4 * SCALE
    inputs = queries(LANES)
    for linear in (0.0, 1.0):
        gp = GaussianProcess(study.task, d=0.1, input_scale=list(2 * SCALE), linear=linear)
        plain = gp.fit(near).correction(inputs[:, :6], inputs[:, 6:])
        fitted = gp.fit(Transitions(near.inputs + away, near.residuals))
        far = inputs + away
        np.testing.assert_allclose(fitted.correction(far[:, :6], far[:, 6:]), plain, rtol=0, atol=1e-11)
        np.testing.assert_allclose(corrections(fitted, far), plain, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_kernel_takes_more_states_than_its_panels_have_rows() -> None:
    rng = np.random.default_rng(0)
    transitions = Transitions(rng.standard_normal((40, 9)), rng.standard_normal((40, 8)))
    fitted = exact(Hyperparameters(np.ones(9), np.full(9, 2.0), 1.6, 0.1, 0.1), transitions)
    inputs = transitions.inputs[:LANES]
    plain = fitted.correction(inputs[:, :8], inputs[:, 8:])
    np.testing.assert_allclose(corrections(fitted, inputs, 8), plain, rtol=0, atol=1e-5)


def test_an_input_without_a_limit_needs_a_scale() -> None:
    """Over infinity, it would be ignored."""
    task = PointMass()
    task.input_limit = np.array([np.inf])
    for component in GaussianProcess, LeastSquaresDensity, Delay:
        with pytest.raises(ValueError, match=r"^force has no limit to scale by: declare one, or "):
            component(task)
    GaussianProcess(task, input_scale=[1.0, 1.0, 10.0])


@pytest.mark.slow
def test_without_data_the_kernel_is_that_of_no_bias() -> None:
    """Searches before the first experiment are as fast as without learning."""
    kernel = ZeroBias(6).kernel
    for option in ("gp", "sparse_gp", "gp_learned", "sparse_gp_learned"):
        study = simbias.load(["tracking=none", f"bias={option}"])
        fitted = study.bias.fit(study.no_data)
        np.testing.assert_allclose(fitted.predict(queries(3))[1], 1 + np.exp(-4))
        for bias in (fitted, fitted.draw(np.random.default_rng(0))):
            assert bias.kernel.function is kernel.function
            np.testing.assert_array_equal(bias.kernel.parameters, kernel.parameters)


@pytest.mark.slow
def test_a_correction_does_not_depend_on_those_beside_it(study: Study) -> None:
    """To the last bit, whatever its lane."""
    for n in (1, 16, 100):
        fitted, inputs = study.bias.fit(data(n)), queries(LANES)
        values = corrections(fitted, inputs)
        np.testing.assert_array_equal(corrections(fitted, inputs[::-1])[::-1], values)
        alone = corrections(fitted, np.where(np.arange(LANES)[:, None] == 5, inputs, np.nan))
        np.testing.assert_array_equal(alone[5], values[5])
        plain = fitted.correction(inputs[:, :6], inputs[:, 6:])
        for row, correction in zip(inputs, plain, strict=True):
            np.testing.assert_array_equal(fitted.correction(row[:6], row[6:]), correction)


@pytest.mark.slow
def test_where_the_exact_posterior_is_too_slow_it_says_so(
    study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once a fit, in one line for a person; the default threshold is at N = 1198."""
    with pytest.warns(StudyWarning) as caught:
        study.bias.fit(data(1200))
    (warning,) = caught
    assert "1200 samples" in str(warning.message)
    assert str(warning.message).endswith("use bias=sparse_gp")
    with warnings_in_one_line():
        study.bias.fit(data(1200))
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("simbias: exact GP, 1200 samples")
    assert len(line) <= 80
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study.bias.fit(data(1000))
        GaussianProcess(study.task, inducing=Inducing(20)).fit(data(1200))


@pytest.mark.slow
def test_a_sweeps_workers_keep_it_to_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not a line for each of hundreds of trials."""
    monkeypatch.setattr("simbias.learning.bias.gp.PATIENCE", 0.0)
    short = ["optimizer.max_evaluations=5", "method.max_iterations=1"]
    trial = simbias.load(["tracking=none", *short]).composition
    with pytest.warns(StudyWarning):
        (iteration,) = build(trial).run()
    assert len(iteration.learning.data) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run_plan(PlannedTrial(trial)).summary.outcome.final


def test_repeated_points_need_jitter_and_get_it() -> None:
    """A singular covariance is factorised all the same, whatever its unit."""
    for size in (1e-6, 1.0, 1e6):
        K = np.full((50, 50), size)
        L = stable_cholesky(K)
        np.testing.assert_allclose(L @ L.T, K, atol=1e-6 * size)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        stable_cholesky(-np.eye(3))


@pytest.mark.filterwarnings("error")
def test_a_state_beyond_all_numbers_is_far_from_all_others_without_a_word() -> None:
    """A simulated one may grow so far before it fails."""
    far, near = np.array([[1e200, 0.0]]), np.ones((1, 2))
    assert correlation(far, near) == 0.0
    assert np.isnan(correlation(np.inf * near, near))


def test_warming_up_compiles_what_a_search_needs_once_something_is_learned(study: Study) -> None:
    """The kernel is another one with data; none of it is left for the first search through it."""
    compile_closed_loop.cache_clear()
    warm_up(study)
    before = compile_closed_loop.cache_info().misses
    for transitions in (study.no_data, data(30)):
        model = study.model(study.bias.fit(transitions))
        evaluation = study.evaluation.objective(model, study.cost, np.random.default_rng(0))
        evaluation(np.zeros(study.policy.n_parameters))
        study.simulate(np.zeros(study.policy.n_parameters), model.bias)
    assert compile_closed_loop.cache_info().misses == before


def along_trajectories(n: int, seed: int = 0) -> Transitions:
    """Smooth residuals along slow oscillations, as experiments give them."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 5, n)[:, None]
    inputs = SCALE * np.sin(rng.uniform(1, 6, 7) * t + rng.uniform(0, 6, 7))
    return Transitions(inputs, 1e-3 * np.tanh(inputs / SCALE @ rng.normal(size=(7, 6))))


def sparse_gp(study: Study, points: int = 200, tolerance: float = 1e-4) -> GaussianProcess:
    return GaussianProcess(study.task, inducing=Inducing(points, tolerance, max(tolerance, 1e-3)))


def test_with_every_point_inducing_it_is_the_exact_posterior(study: Study) -> None:
    for n in (1, 2, 40):
        data = along_trajectories(n)
        every_point = GaussianProcess(study.task, inducing=Inducing(n, 1e-12, 1e-12))
        mean, variance = every_point.fit(data).predict(queries(50))
        exact_mean, exact_variance = GaussianProcess(study.task).fit(data).predict(queries(50))
        np.testing.assert_allclose(mean, exact_mean, rtol=0, atol=1e-7)
        relative_error = (variance - exact_variance) / np.mean(data.residuals**2, axis=0)
        np.testing.assert_allclose(relative_error, 0, atol=1e-4)


@pytest.mark.slow
def test_error_shrinks_with_inducing_points(study: Study) -> None:
    """The reported errors are those that are measured here, and get small long before m = N."""
    data = along_trajectories(600)
    exact_mean, exact_variance = GaussianProcess(study.task).fit(data).predict(data.inputs[::3])
    mean_squares, errors = np.mean(data.residuals**2, axis=0), []
    for m in (5, 20, 80):
        fitted = sparse_gp(study, m).fit(data)
        mean, variance = fitted.predict(data.inputs[::3])
        weights = (np.exp(-np.sum(each / mean_squares, axis=1)) for each in (variance, exact_variance))
        assert fitted.diagnostics["weight_error"] == pytest.approx(np.abs(np.subtract(*weights)).max())
        errors.append(np.abs(mean - exact_mean).max() / np.sqrt(np.mean(data.residuals**2)))
        assert fitted.diagnostics["mean_error"] == pytest.approx(errors[-1])
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.01


def test_error_of_the_mean_counts_the_linear_function(study: Study) -> None:
    """It and the process share the mean in other ways where there are fewer points."""
    data = along_trajectories(150)
    fitted = GaussianProcess(study.task, inducing=Inducing(40, 1e-4, 1e-3), linear=3.0).fit(data)
    exact_mean, _ = GaussianProcess(study.task, linear=3.0).fit(data).predict(data.inputs)
    error = np.abs(fitted.predict(data.inputs)[0] - exact_mean).max()
    assert fitted.diagnostics["mean_error"] * np.sqrt(np.mean(data.residuals**2)) == pytest.approx(error)


def test_variance_needs_fewer_points(study: Study) -> None:
    """Near the data it changes by less than the tolerance, and so does the weight of Eq. 7 by little."""
    data = along_trajectories(600)
    as_many = GaussianProcess(study.task, inducing=Inducing(200, 1e-4, 1e-4)).fit(data)
    fewer = sparse_gp(study).fit(data)
    assert fewer.diagnostics["inducing_points_of_variance"] < as_many.diagnostics["inducing_points"]
    assert fewer.diagnostics["inducing_points"] == as_many.diagnostics["inducing_points"]
    assert fewer.diagnostics["weight_error"] < 0.01
    for inputs, most in ((data.inputs, 1e-3), (queries(50), 0.05)):  # of the signal's variance; off the data
        (mean, variance), (same_mean, other) = fewer.predict(inputs), as_many.predict(inputs)
        np.testing.assert_allclose(mean, same_mean, rtol=1e-9)
        assert (np.abs(variance - other) < most * np.mean(data.residuals**2, axis=0)).all()


def test_points_are_chosen_to_a_part_of_the_signals_variance() -> None:
    """Those of the variance are what its own tolerance would choose alone."""
    inputs = along_trajectories(200).inputs / SCALE
    for alpha_squared in (0.4, 2.5):
        hyper = Hyperparameters(np.ones(7), np.ones(7), alpha_squared, 0.1, 1.0)
        chosen, for_variance = choose(hyper, inputs, Inducing(200, 1e-4, 1e-2))
        assert choose(hyper, inputs, Inducing(200, 1e-2, 1e-2)) == (chosen[:for_variance], for_variance)
        L = stable_cholesky(hyper.covariance(inputs[chosen], inputs[chosen]))
        known = np.sum(np.linalg.solve(L, hyper.covariance(inputs[chosen], inputs)) ** 2, axis=0)
        assert (alpha_squared - known).max() == pytest.approx(1e-4 * alpha_squared, rel=0.6)
        one_less = choose(hyper, inputs, Inducing(len(chosen) - 1, 1e-4, 1e-2))
        assert one_less == (chosen[:-1], for_variance)


def test_points_of_the_variance_are_among_those_of_the_mean() -> None:
    with pytest.raises(ConfigError, match="variance_tolerance"):
        simbias.load(["bias=sparse_gp", "bias.inducing.variance_tolerance=1e-5"])


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
@settings(max_examples=10, deadline=None)
def test_variance_lies_between_the_noise_and_the_prior(study: Study, seed: int, m: int) -> None:
    """However few points: K_ZZ^-1 - S is positive semidefinite, and no more than K_ZZ^-1."""
    data = along_trajectories(150, seed)
    _, variance = sparse_gp(study, m).fit(data).predict(queries(30))
    relative = variance / np.mean(data.residuals**2, axis=0)
    assert (relative >= np.exp(-4) - 1e-5).all()
    assert (relative <= 1 + np.exp(-4) + 1e-9).all()


@pytest.mark.slow
def test_learned_noise_is_resolved_by_the_inducing_points() -> None:
    """Without noise in the data the learned one is small, and the points are finer."""
    fitted = simbias.load(["tracking=none", "bias=sparse_gp_learned"]).bias.fit(along_trajectories(300))
    assert fitted.diagnostics["noise_variance"] < 1e-3
    assert fitted.diagnostics["mean_error"] < 0.02
