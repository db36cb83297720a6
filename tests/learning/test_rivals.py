"""What others learn in place of the paper's bias, each on a case where it must work; and the controls."""

from functools import cache

import numpy as np
import pytest
from in_lanes import corrections
from threadpoolctl import threadpool_info, threadpool_limits

import simbias
from simbias.core.records import Array, Transitions
from simbias.learning.bias import lscde
from simbias.robots.none import NoNominal
from simbias.trial.study import Study


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole", "tracking=none"])


@cache
def bias_of(option: str):
    return simbias.load(["preset=cartpole", "tracking=none", f"bias={option}"]).bias


def points(k: int, seed: int = 0) -> Array:
    """Raw inputs (k, 5) of the cart-pole: four states and a force."""
    return np.random.default_rng(seed).normal(size=(k, 5)) * [0.3, 0.1, 0.5, 0.5, 50.0]


def smooth(inputs: Array) -> Array:
    """Residuals (k, 4) that depend on the state."""
    return 1e-2 * np.sin(3.0 * inputs[:, :4]) + 3e-3


@pytest.mark.slow
def test_permuted_residuals_carry_no_state() -> None:
    """They have the size of the true ones, and predict them no better than their mean does."""
    data, held_out = Transitions(points(150), smooth(points(150))), points(200, seed=1)
    fitted = {name: bias_of(name).fit(data) for name in ("gp", "permuted_gp", "mean")}
    errors = {k: np.mean((each.predict(held_out)[0] - smooth(held_out)) ** 2) for k, each in fitted.items()}
    assert errors["gp"] < 0.1 * errors["mean"]
    assert errors["permuted_gp"] > errors["mean"]
    added = fitted["mean"].correction(held_out[:, :4], held_out[:, 4:])
    np.testing.assert_allclose(added, np.tile(data.residuals.mean(axis=0), (200, 1)))


def test_a_motor_gain_is_a_residual_of_the_input(cartpole: Study) -> None:
    """A motor that gives 70%: delta u = -0.3 u explains all states' residuals at once."""
    inputs, held_out = points(200), points(50, seed=1)

    def residual(z: Array) -> Array:
        x, u = z[:, :4], z[:, 4:]
        return cartpole.nominal.step(x, 0.7 * u) - cartpole.nominal.step(x, u)

    learner, data = bias_of("input_residual"), Transitions(inputs, residual(inputs))
    with pytest.raises(ValueError, match="the nominal model does not depend on the inputs"):
        learner.learn(data, [], NoNominal(cartpole.task))
    fitted = learner.learn(data, [], cartpole.nominal)
    x, u = held_out[:, :4], held_out[:, 4:]
    mean, _ = fitted.predict(held_out)
    assert np.sqrt(np.mean((mean - residual(held_out)) ** 2)) < 0.15 * residual(held_out).std()
    error = np.abs(fitted.correction(x, u) - residual(held_out)).mean()
    assert error < 0.5 * np.abs(residual(held_out)).mean()


@pytest.mark.slow
def test_a_residual_of_accelerations_moves_positions_by_a_part_of_a_frame() -> None:
    """Where forces alone are missing, half a frame's; what positions have besides is left to the model."""
    inputs = points(150)
    pushes = np.sin(inputs[:, 2:4]) + 0.3
    forced = Transitions(inputs, np.concatenate([0.025 * pushes, pushes], axis=1))
    fitted, whole = (bias_of(name).fit(forced) for name in ("acceleration_residual", "sparse_gp"))
    np.testing.assert_allclose(fitted.predict(inputs)[0], whole.predict(inputs)[0], rtol=1e-9, atol=1e-12)
    moved = Transitions(inputs, forced.residuals + np.where(np.arange(4) < 2, inputs[:, 4:] ** 2, 0.0))
    mean, _ = bias_of("acceleration_residual").fit(moved).predict(inputs)
    ratios = mean[:, :2] / mean[:, 2:]
    np.testing.assert_allclose(ratios, np.broadcast_to(ratios[0], ratios.shape), rtol=1e-6)
    still = Transitions(inputs, np.zeros((150, 4)))
    assert not bias_of("acceleration_residual").fit(still).predict(inputs)[0].any()


@pytest.mark.slow
def test_lscde_finds_a_known_conditional_density() -> None:
    """A mixture whose two branches part with the state: no Gaussian process has such a density."""
    rng = np.random.default_rng(3)
    inputs = points(800) * [1, 0, 0, 0, 0]
    branch = rng.choice([-1.0, 1.0], len(inputs))
    residuals = np.zeros((len(inputs), 4))
    deviation = 0.15
    residuals[:, 0] = branch * (1.0 + inputs[:, 0]) + deviation * rng.standard_normal(len(inputs))
    fitted = bias_of("lscde").fit(Transitions(inputs, residuals))
    values, centre = np.linspace(-2, 2, 201), np.zeros((1, 5))
    found = fitted.density(centre, values, 0)[0]
    modes = [np.exp(-((values - mode) ** 2) / (2 * deviation**2)) for mode in (-1.0, 1.0)]
    true = sum(modes) / (2 * np.sqrt(2 * np.pi) * deviation)
    step = values[1] - values[0]
    assert found.sum() * step == pytest.approx(1.0, abs=0.05)
    assert np.abs(found - true).sum() * step < 0.8 * np.abs(true).sum() * step  # nearer than zero is
    assert found[[50, 150]].min() > 2 * found[100]  # two modes, and none between
    mean, variance = fitted.predict(centre)
    assert abs(mean[0, 0]) < 0.15
    assert variance[0, 0] == pytest.approx(1.0 + deviation**2, rel=0.25)


@pytest.mark.slow
def test_lscde_is_fitted_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: set[int] = set()

    def noted(H: Array, h: Array, regularisation: float) -> Array:
        threads.update(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return h

    monkeypatch.setattr(lscde, "_weights", noted)
    with threadpool_limits(2, user_api="blas"):
        bias_of("lscde").fit(Transitions(points(10), smooth(points(10))))
    assert threads == {1}


@pytest.mark.slow
def test_lscde_predicts_means_and_is_zero_far_from_data() -> None:
    data, held_out = Transitions(points(300), smooth(points(300))), points(100, seed=1)
    fitted = bias_of("lscde").fit(data)
    error = np.mean((fitted.predict(held_out)[0] - smooth(held_out)) ** 2)
    assert error < 0.4 * smooth(held_out).var()
    plain = fitted.correction(held_out[:, :4], held_out[:, 4:])
    np.testing.assert_allclose(corrections(fitted, held_out, 4), plain, rtol=0, atol=1e-6)
    far = np.full((1, 5), 1e3)
    np.testing.assert_allclose(fitted.predict(far)[0], 0.0, atol=1e-12)
    away = np.array([1e4, 0, 0, 0, 0])  # where single precision would lose four digits
    elsewhere = bias_of("lscde").fit(Transitions(data.inputs + away, data.residuals))
    np.testing.assert_allclose(corrections(elsewhere, held_out + away, 4), plain, rtol=0, atol=1e-6)
