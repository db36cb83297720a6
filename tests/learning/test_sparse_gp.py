"""The posterior through inducing points against the exact one, and its own limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import simbias
from simbias.config import ConfigError
from simbias.core.records import Array, Transitions
from simbias.learning.bias.covariance import Hyperparameters, stable_cholesky
from simbias.learning.bias.gp import GaussianProcess
from simbias.learning.bias.inducing import Inducing, choose
from simbias.trial.study import Study

SCALE = np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0, 30.0])  # of plausible states and torques


def along_trajectories(n: int, seed: int = 0) -> Transitions:
    """Smooth residuals along slow oscillations, as experiments give them."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 5, n)[:, None]
    inputs = SCALE * np.sin(rng.uniform(1, 6, 7) * t + rng.uniform(0, 6, 7))
    return Transitions(inputs, 1e-3 * np.tanh(inputs / SCALE @ rng.normal(size=(7, 6))))


def sparse_gp(study: Study, points: int = 200, tolerance: float = 1e-4) -> GaussianProcess:
    return GaussianProcess(study.task, inducing=Inducing(points, tolerance, max(tolerance, 1e-3)))


def queries(k: int) -> Array:
    return np.random.default_rng(99).normal(size=(k, 7)) * SCALE


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


def test_learned_noise_is_resolved_by_the_inducing_points() -> None:
    """Without noise in the data the learned one is small, and the points are finer."""
    fitted = simbias.load(["tracking=none", "bias=sparse_gp_learned"]).bias.fit(along_trajectories(300))
    assert fitted.diagnostics["noise_variance"] < 1e-3
    assert fitted.diagnostics["mean_error"] < 0.02
