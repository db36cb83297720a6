"""Functions that are drawn from the posterior have its mean and covariance, and run on its kernel."""

from functools import cache

import numpy as np
import pytest
from in_lanes import corrections

import simbias
from simbias.core import FittedBias
from simbias.core.records import Array, Transitions
from simbias.simulation.compiled import CompiledSimulator
from simbias.trial.study import Study

OPTIONS = ["gp", "sparse_gp_learned"]
DRAWS = 1000


def data(n: int = 60) -> Transitions:
    rng = np.random.default_rng(5)
    inputs = rng.uniform(-1, 1, (n, 7)) * [0.3, 0.3, 0.3, 1.0, 1.0, 1.0, 30.0]
    function = np.sin(inputs[:, :6] * 2) + inputs[:, 6:] / 50
    noise = 0.3 * rng.standard_normal((n, 6))
    return Transitions(inputs, (function + noise) * [1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3])


@cache
def fitted(option: str) -> FittedBias:
    return simbias.load(["tracking=none", f"bias={option}"]).bias.fit(data())


def scale() -> Array:
    return np.sqrt(np.mean(data().residuals ** 2, axis=0))


@pytest.mark.slow
def test_draws_have_the_posteriors_mean_and_variance() -> None:
    """At training inputs, which inducing points cover; tolerances are five standard errors.

    Far from data they return to zero: what the points leave open is not drawn, as Eq. 7 has it.
    """
    for option in OPTIONS:
        posterior, inputs = fitted(option), data().inputs[::10]
        mean, variance = posterior.predict(inputs)
        rng = np.random.default_rng(0)
        values = np.array([posterior.draw(rng).predict(inputs)[0] for _ in range(DRAWS)]) / scale()
        hyper = posterior.hyper
        latent = variance / scale() ** 2 - hyper.noise_variance  # what is uncertain of the function itself
        assert (latent > 1e-3).all()
        error = values.mean(axis=0) - mean / scale()
        assert (np.abs(error) < 5 * np.sqrt(latent / DRAWS)).all()
        slack = 5 * np.sqrt(2 / DRAWS)
        np.testing.assert_allclose(values.var(axis=0), latent, rtol=slack, atol=2e-4)
        far = posterior.draw(rng).predict(np.full((1, 7), 1e3))
        np.testing.assert_allclose(far, 0.0, atol=1e-12)


@pytest.mark.slow
def test_draws_have_the_posteriors_covariance() -> None:
    """Between inputs that of the exact latent posterior; between outputs none."""
    t = np.linspace(-3, 3, 30)
    transitions = Transitions(t[:, None] * np.eye(7)[0], np.sin(t)[:, None] * np.ones(6))
    posterior = simbias.load(["tracking=none"]).bias.fit(transitions)
    inputs, scale = transitions.inputs[10:15], np.sqrt(np.mean(np.sin(t) ** 2))
    rng = np.random.default_rng(0)
    values = np.array([posterior.draw(rng).predict(inputs)[0] for _ in range(DRAWS)]) / scale
    hyper, points = posterior.hyper, posterior.hyper.scale(transitions.inputs)
    K = hyper.covariance(points, points)
    k = K[10:15]
    expected = k[:, 10:15] - k @ np.linalg.solve(K + hyper.noise_variance * np.eye(len(K)), k.T)
    assert np.abs(expected[0, 1:]).max() > 0.5 * expected[0, 0]
    got = np.mean([np.cov(values[:, :, output].T) for output in range(6)], axis=0)
    np.testing.assert_allclose(got, expected, atol=5 * expected.max() / np.sqrt(6 * DRAWS) + 1e-4)
    between_outputs = np.corrcoef(values[:, 0, :].T) - np.eye(6)
    assert np.abs(between_outputs).max() < 5 / np.sqrt(DRAWS)


@pytest.mark.slow
def test_kernels_agree_with_the_plain_posterior_and_its_draws() -> None:
    inputs, draws = data().inputs[:16], [fitted(option).draw(np.random.default_rng(1)) for option in OPTIONS]
    for each in (fitted("sparse_gp_learned"), *draws):
        fast, plain = corrections(each, inputs), each.correction(inputs[:, :6], inputs[:, 6:])
        np.testing.assert_allclose(fast / scale(), plain / scale(), rtol=0, atol=1e-3)


def pendulum(option: str = "sparse_gp_learned", *values: str) -> Study:
    """A pendulum of whose dynamics nothing is known; its draws vary where there are no data."""
    scratch = ["preset=[pendulum_swingup,scratch]", "tracking=none", f"bias={option}"]
    return simbias.load([*scratch, "bias.periodic=true", "bias.fourier_features=32", *values])


def swings(n: int = 60) -> Transitions:
    """Residuals of a pendulum near its lower rest, at up to 1 rad from it."""
    rng = np.random.default_rng(6)
    inputs = rng.uniform(-1, 1, (n, 3)) * [1.0, 4.0, 2.5] + [np.pi, 0.0, 0.0]
    rate = 0.02 * (15.0 * np.sin(inputs[:, 0]) + 3.0 * inputs[:, 2]) + 0.01 * rng.standard_normal(n)
    return Transitions(inputs, np.stack([0.01 * rate, rate], axis=1))


UPRIGHT_TO_HANGING = np.stack([np.linspace(0.0, np.pi, 7), np.linspace(-2, 2, 7), np.zeros(7)], axis=1)


@pytest.mark.slow
def test_with_fourier_features_draws_have_the_posteriors_moments_where_there_are_no_data() -> None:
    """At the data and half a turn away; tolerances are five standard errors.

    So they have where the exact posterior of many samples needs more points than a sparse one may have.
    """
    cases = ("gp", 0.0, 1.0, 60), ("sparse_gp_learned", 3.0, 1.0, 60), ("gp", 3.0, 0.25, 500)
    for option, linear, length, n in cases:
        study = pendulum(option, f"bias.linear={linear}", f"bias.length_scale={length}")
        bias, rng = study.bias.fit(swings(n)), np.random.default_rng(0)
        mean, variance = bias.predict(UPRIGHT_TO_HANGING)
        scale = np.sqrt(np.mean(swings(n).residuals ** 2, axis=0))
        values = np.array([bias.draw(rng).predict(UPRIGHT_TO_HANGING)[0] for _ in range(DRAWS)]) / scale
        latent = variance / scale**2 - bias.hyper.noise_variance
        assert latent[0].min() > 5 * latent[-1].max(), option  # upright, where it has not been
        assert (np.abs(values.mean(axis=0) - mean / scale) < 5 * np.sqrt(latent / DRAWS)).all(), option
        squares = (values - values.mean(axis=0)) ** 2  # more than normal tails, as the features are few
        error = np.abs(squares.mean(axis=0) - latent)
        assert (error < 5 * squares.std(axis=0) / np.sqrt(DRAWS) + 2e-4).all(), option


@pytest.mark.slow
def test_periodic_biases_are_the_same_after_a_turn() -> None:
    bias = pendulum().bias.fit(swings())
    turned = UPRIGHT_TO_HANGING + np.array([2 * np.pi, 0.0, 0.0])
    for each in (bias, bias.draw(np.random.default_rng(0))):
        once, again = (each.correction(x[:, :2], x[:, 2:]) for x in (UPRIGHT_TO_HANGING, turned))
        np.testing.assert_allclose(once, again, rtol=0, atol=1e-9)
        x = np.repeat(UPRIGHT_TO_HANGING, 2, axis=0)
        plain = each.correction(x[:, :2], x[:, 2:])
        # Of 0.25, in single precision.
        np.testing.assert_allclose(corrections(each, x, 2), plain, rtol=0, atol=2e-4)
    off = simbias.load(["preset=[pendulum_swingup,scratch]", "bias.periodic=false"]).bias.fit(swings())
    assert np.abs(np.subtract(*(off.predict(x)[0] for x in (UPRIGHT_TO_HANGING, turned)))).max() > 1e-3


@pytest.mark.slow
def test_scenarios_with_drawn_functions_follow_the_generator() -> None:
    """Compiled, each with a function of its own; the same numbers of the same generator."""
    options = ["evaluation=domain_randomization", "evaluation.sample_bias=true", "evaluation.rollouts=3"]
    study = simbias.load(["tracking=none", "bias=sparse_gp_learned", "task.horizon=60", *options])
    bias, theta = study.bias.fit(data()), np.full(study.policy.n_parameters, 0.5)
    one, again, other = (
        study.evaluation.objective(study.model(bias), study.cost, np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    costs = one.together(theta[None])
    np.testing.assert_array_equal(costs, again.together(theta[None]))
    assert costs != other.together(theta[None])
    each = [s.simulator.costs(study.cost, theta[None], s.start[None])[0] for s in one.scenarios]
    assert all(isinstance(scenario.simulator, CompiledSimulator) for scenario in one.scenarios)
    assert np.ptp(each) > 1e-6
