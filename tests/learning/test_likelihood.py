"""Learned hyper-parameters against SciPy, scikit-learn, finite differences, and functions of known ones."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import check_grad
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

import simbias
from simbias.core.records import Array, Transitions
from simbias.learning import likelihood
from simbias.learning.covariance import Hyperparameters
from simbias.learning.likelihood import LEAST_NOISE, REACH, HyperPriors, learn, log_marginal_likelihood, mode
from simbias.trial.study import Study

pytestmark = pytest.mark.slow


def medians(r: int) -> Hyperparameters:
    return Hyperparameters(np.ones(r), np.ones(r), 1.0, np.exp(-4), 1.0)


def drawn(hyper: Hyperparameters, N: int, outputs: int, seed: int = 0) -> Transitions:
    """Residuals that were drawn from the process, at uniform inputs."""
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(-2, 2, (N, len(hyper.length_scale)))
    points = hyper.scale(inputs)
    K = hyper.covariance(points, points) + hyper.noise_variance * np.eye(N)
    return Transitions(inputs, np.linalg.cholesky(K) @ rng.standard_normal((N, outputs)))


@given(
    st.lists(st.floats(-1.5, 1.5), min_size=5, max_size=5),
    st.integers(1, 25),
    st.integers(0, 100),
    st.sampled_from([0.0, 0.5, 5.0]),
)
@settings(max_examples=15, deadline=None)
def test_likelihood_is_scipys_and_its_gradient_is_that_of_finite_differences(
    theta: list[float], N: int, seed: int, linear: float
) -> None:
    """Alone, and with a linear function."""
    data = drawn(medians(3), N, 2, seed)
    basis = linear * replace(medians(3), linear=1.0).basis(data.inputs)
    known = data.inputs, data.residuals, basis @ basis.T
    value, _ = log_marginal_likelihood(np.array(theta), *known)
    *lengths, signal, noise_ratio = np.exp(theta)
    z = data.inputs / lengths
    K = signal * (np.exp(-0.5 * cdist(z, z, "sqeuclidean")) + noise_ratio * np.eye(N))
    K += linear**2 * (1.0 + data.inputs @ data.inputs.T)
    normal = multivariate_normal(np.zeros(N), K)
    assert value == pytest.approx(np.sum(normal.logpdf(data.residuals.T)), rel=1e-9, abs=1e-9)
    functions = [lambda theta, part=part: log_marginal_likelihood(theta, *known)[part] for part in (0, 1)]
    gradient = functions[1](np.array(theta))
    error = check_grad(*functions, np.array(theta), epsilon=1e-6)
    assert error < 1e-4 * max(1.0, np.linalg.norm(gradient))


def test_optimum_is_scikit_learns() -> None:
    """Where priors say nothing."""
    from sklearn.gaussian_process import GaussianProcessRegressor  # lazily: it takes seconds
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    data = drawn(Hyperparameters(np.ones(2), np.array([0.7, 1.5]), 1.0, 0.1, 1.0), 60, 1)
    hyper = learn(medians(2), data, HyperPriors(1e3, 1e3, 1e3))
    kernel = ConstantKernel() * RBF(np.ones(2)) + WhiteKernel(np.exp(-4))
    residuals = data.residuals / np.sqrt(np.mean(data.residuals**2))
    reference = GaussianProcessRegressor(kernel, alpha=0.0).fit(data.inputs, residuals).kernel_
    np.testing.assert_allclose(hyper.length_scale, reference.k1.k2.length_scale, rtol=1e-3)
    assert hyper.signal_variance == pytest.approx(reference.k1.k1.constant_value, rel=1e-3)
    assert hyper.noise_variance == pytest.approx(reference.k2.noise_level, rel=1e-3)


def test_data_far_from_zero_teach_the_same() -> None:
    data = drawn(medians(2), 60, 1)
    far = Transitions(data.inputs + np.array([1e7, 0.0]), data.residuals)
    near, there = (learn(medians(2), each, HyperPriors()).length_scale for each in (data, far))
    np.testing.assert_allclose(there, near, rtol=1e-3)


def test_what_is_learned_is_the_mode_of_likelihood_and_prior() -> None:
    """The prior's pull on each logarithm is the likelihood's slope."""
    data = drawn(Hyperparameters(np.ones(2), np.full(2, 0.5), 1.0, 0.3, 1.0), 80, 2)
    y = data.residuals / np.sqrt(np.mean(data.residuals**2, axis=0))
    for deviation in (1.0, 0.5):
        hyper = learn(medians(2), data, HyperPriors(deviation, deviation, deviation))
        ratio = hyper.noise_variance / hyper.signal_variance
        theta = np.log([*hyper.length_scale, hyper.signal_variance, ratio])
        _, slope = log_marginal_likelihood(theta, data.inputs, y)
        pull = (theta - [0.0, 0.0, 0.0, -4.0]) / deviation**2
        assert np.abs(pull).max() > 1
        np.testing.assert_allclose(slope, pull, atol=0.02)


def test_what_has_no_deviation_is_kept() -> None:
    data = drawn(Hyperparameters(np.ones(2), np.full(2, 0.5), 1.0, 0.3, 1.0), 80, 2)
    before, every = medians(2), learn(medians(2), data, HyperPriors())
    assert (every.length_scale != 1).all()
    lengths_kept = learn(before, data, HyperPriors(length_scale=0))
    np.testing.assert_allclose(lengths_kept.length_scale, 1.0, rtol=1e-12)
    assert lengths_kept.noise_variance > 2 * before.noise_variance
    for known in (before, replace(before, signal_variance=2.5)):
        all_kept = learn(known, data, HyperPriors(0, 0, 0))
        assert all_kept.signal_variance == pytest.approx(known.signal_variance, rel=1e-12)
        assert all_kept.noise_variance == pytest.approx(known.noise_variance, rel=1e-12)


def test_a_linear_function_leaves_the_process_what_is_not_linear() -> None:
    """Of a line and a small wave, the signal is that of the wave, and its length scale the wave's."""
    x = np.random.default_rng(4).uniform(-3, 3, (150, 2))
    wave = 0.1 * np.sin(2 * x[:, :1])
    data = Transitions(x, 40.0 + x @ [[1.0], [-3.0]] + wave)
    with_line, without = (
        learn(replace(medians(2), linear=linear), data, HyperPriors()) for linear in (10.0, 0.0)
    )
    assert 0.3 < with_line.length_scale[0] < 1.5 < without.length_scale[0]
    assert with_line.signal_variance < 1e-3 < without.signal_variance


def test_residuals_that_are_rounding_have_no_say() -> None:
    """In single or double precision, or zero; how small they are is no evidence for a model."""
    data = drawn(medians(3), 60, 1)
    alone, evidence = mode(medians(3), data, HyperPriors())[0], []
    x = data.inputs[:, 1:2]
    for rounded in (x - x.astype(np.float32), x / 3 * 3 - x, 0 * x):
        both = Transitions(data.inputs, np.hstack([data.residuals, rounded]))
        found, log_evidence = mode(medians(3), both, HyperPriors())
        np.testing.assert_array_equal(found.length_scale, alone.length_scale)
        assert found.noise_variance == alone.noise_variance
        evidence.append(log_evidence)
    assert np.ptp(evidence) == 0


def test_few_samples_and_constant_outputs_are_learned_from() -> None:
    options = ("gp_learned", "sparse_gp_learned")
    learners = [simbias.load(["tracking=none", f"bias={option}"]).bias for option in options]
    for bias, N in product(learners, (0, 1, 2, 15)):
        rng = np.random.default_rng(N)
        inputs, noise = rng.standard_normal((N, 7)), 1e-3 * rng.standard_normal((N, 6))
        constant = np.zeros((N, 6)), np.full((N, 6), 1e-3)
        for residuals in (*constant, noise * (np.arange(6) != 2), noise):
            fitted = bias.fit(Transitions(inputs, residuals))
            mean, variance = fitted.predict(inputs)
            assert np.isfinite(mean).all()
            assert (variance >= 0).all()
            if any(residuals is each for each in constant):
                np.testing.assert_allclose(mean, residuals, rtol=0.05)
            names = [name for name in fitted.diagnostics if name.startswith("length_scale_")]
            assert len(names) == 7
            assert min(fitted.diagnostics[name] for name in names) > 0


def test_it_is_deterministic_and_noise_stays_resolvable(study: Study) -> None:
    """Without noise its variance ends at the bound, not at zero; inputs are scaled as the task says."""
    rng = np.random.default_rng(3)
    inputs = rng.uniform(-1, 1, (120, 7)) * [0.3, 0.3, 0.3, 1, 1, 1, 30]
    data = Transitions(inputs, 1e-3 * np.sin(inputs[:, :6] + inputs[:, 6:] / 100))
    learner = simbias.load(["tracking=none", "bias=gp_learned"]).bias
    first, again = learner.fit(data).diagnostics, learner.fit(data).diagnostics
    assert first == again
    assert first["noise_variance"] >= LEAST_NOISE * first["signal_variance"] * (1 - 1e-9)
    errors = []
    for bias in (study.bias, learner):
        mean, _ = bias.fit(Transitions(data.inputs[:80], data.residuals[:80])).predict(data.inputs[80:])
        errors.append(np.sqrt(np.mean((mean - data.residuals[80:]) ** 2)))
    assert errors[1] < errors[0] / 2


def test_no_line_search_leaves_what_the_priors_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Length scales of 1e-8 make distances rounding, and the covariance no covariance."""
    tried: list[Array] = []

    def recorded(theta: Array, *data: Array) -> tuple[float, Array]:
        tried.append(theta)
        return log_marginal_likelihood(theta, *data)

    monkeypatch.setattr(likelihood, "log_marginal_likelihood", recorded)
    for seed in (167, 283):  # whose searches went to 22 and 42 without bounds
        rng = np.random.default_rng(seed)
        x = np.cumsum(rng.normal(size=(60, 3)), axis=0)
        x[:, 1] = np.repeat(rng.choice([-10.0, 10.0], 12), 5)  # an input at its limits
        y = np.cumsum(rng.normal(size=(60, 2)), axis=0) * 0.05 + np.sin(3 * x[:, :1])
        learn(medians(3), Transitions(x, y), HyperPriors())
    assert 5.0 < np.abs(np.array(tried)).max() <= REACH + 4.0  # the medians are within 4
