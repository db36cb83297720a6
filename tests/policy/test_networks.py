"""Policies that are not linear: their formulas, limits and observers, compiled as they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from omegaconf import OmegaConf

import simbias
from simbias.config.components import construct
from simbias.core import Model, Policy, Task
from simbias.policy.network import Network
from simbias.policy.observer import OBSERVERS, ObserverKind
from simbias.policy.switched import Switched
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.linearization import linearization
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.study import Study

CARTPOLE: Any = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "task" / "cartpole.yaml"))


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole"])


@pytest.fixture(scope="module")
def turning() -> Task:
    """The cart-pole, whose angle wraps and which does not fail."""
    states = CARTPOLE["states"] | {"angle": {"unit": "rad", "mean": 0.3, "deviation": 0.1, "wraps": True}}
    return construct({**CARTPOLE, "states": states, "failure": None}, Task, "task")


def drawn(policy: Policy, count: int, scale: float = 0.3) -> np.ndarray:
    lower, upper = policy.bounds
    centre = (lower + upper) / 2
    return centre + scale * np.random.default_rng(0).uniform(
        lower - centre, upper - centre, (count, len(lower))
    )


def test_a_perceptron_and_radial_basis_functions_are_their_formulas(cartpole: Study) -> None:
    task, z = cartpole.task, np.array([0.1, -0.2, 0.3, 0.4])
    mlp = Network(task, cartpole.nominal, units=3)
    theta = drawn(mlp, 1)[0]
    V, b, W, c = theta[:12].reshape(3, 4), theta[12:15], theta[15:18], theta[18]
    u, _ = mlp.act(theta, z, 0.0, np.empty(0))
    assert u == pytest.approx(300 * np.tanh(W @ np.tanh(V @ z + b) + c))
    rbf = Network(task, cartpole.nominal, "rbf", units=3)
    theta = drawn(rbf, 1)[0]
    centres, widths, W = theta[:12].reshape(3, 4), np.exp(theta[12:16]), theta[16:]
    v = W @ np.exp(-0.5 * (((z - centres) / widths) ** 2).sum(axis=1))
    u, _ = rbf.act(theta, z, 0.0, np.empty(0))
    assert u == pytest.approx(300 * (9 * np.sin(v) + np.sin(3 * v)) / 8)
    everywhere = rbf.act(drawn(rbf, 100, 1.0), np.tile(z, (100, 1)), 0.0, np.empty((100, 0)))[0]
    assert np.abs(everywhere).max() <= 300


@pytest.mark.slow
@pytest.mark.parametrize("observer", OBSERVERS)
def test_compiled_they_are_what_they_are_in_numpy(
    cartpole: Study, turning: Task, observer: ObserverKind
) -> None:
    """With noise, and around a turn; every other observer is a switched policy's."""
    policy: Policy = Network(turning, cartpole.nominal, errors=True, observer=observer)
    if observer in ("filter", "model"):
        policy = Switched(turning, cartpole.nominal, "rbf", units=5, observer=observer)
    noise = Noise(turning, {"velocity_variance": 1e-4}).draw(np.random.default_rng(0))
    starts = np.array([[0.0, 3.0, 0.0, 1.0], [0.0, 0.02, 0.0, 0.0]])
    model = Model(turning, policy, cartpole.nominal, cartpole.bias.fit(cartpole.no_data))
    compiled, plain = CompiledSimulator.of(model, noise), PlainSimulator([model], [noise])
    assert compiled is not None
    thetas = drawn(policy, 2)
    for one, other in zip(compiled.rollouts(thetas, starts), plain.rollouts(thetas, starts), strict=True):
        np.testing.assert_allclose(one.inputs[:30], other.inputs[:30], rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(one.states[:30], other.states[:30], rtol=1e-5, atol=1e-6)


def test_it_switches_where_the_regulator_holds_and_not_at_once_back(cartpole: Study, turning: Task) -> None:
    policy = Switched(turning, cartpole.nominal, hysteresis=4.0)
    theta = np.zeros(policy.n_parameters)  # the network's inputs are zero; level 1
    A, B = linearization(cartpole.nominal, np.zeros(4), np.zeros(1), turning.input_limit)
    e = np.array([0.0, 0.05, 0.0, 0.0])
    u, on = policy.act(theta, e, 0.0, np.zeros(1))
    assert on == [1.0]
    K = np.stack([-policy.act(theta, 0.01 * row, 0.0, np.zeros(1))[0] / 0.01 for row in np.eye(4)], axis=-1)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1.0
    np.testing.assert_allclose(u, -K @ e, rtol=1e-9)
    edge = next(s for s in np.arange(1.0, 20.0, 0.05) if policy.act(theta, s * e, 0.0, np.zeros(1))[1] == 0)
    assert np.abs(K @ e) * edge <= 1.05 * turning.input_limit  # where it takes over, it is not cut off
    for size, before, after in ((1.5, 1.0, 1.0), (1.5, 0.0, 0.0), (2.5, 1.0, 0.0)):
        assert policy.act(theta, size * edge * e, 0.0, np.array([before]))[1] == after
    turned = policy.act(theta, e + 2 * np.pi * np.eye(4)[1], 0.0, np.zeros(1))
    np.testing.assert_allclose(turned[0], u)


def test_observers_know_rates_better_than_sensors(cartpole: Study, turning: Task) -> None:
    """Of a pole that falls, with measured rates that are noisy; around the turn, too."""
    rng, n = np.random.default_rng(0), 200
    x, u = np.zeros((n, 4)), np.zeros((n, 1))
    x[0, 1] = 0.3
    for t in range(n - 1):
        x[t + 1] = cartpole.nominal.step(x[t], u[t])
    seen = x + rng.standard_normal((n, 4)) * [1e-4, 1e-4, 2.0, 2.0]
    seen[:, 1] = (seen[:, 1] + np.pi) % (2 * np.pi) - np.pi
    errors = {}
    for kind, make in OBSERVERS.items():
        observer = make(turning, cartpole.nominal)
        gains = {"filter": [0.6], "derivative": [0.9], "model": [0.9, 0.1]}.get(kind, [])
        kept, estimates = np.zeros(observer.size), []
        for t in range(n):
            estimates.append(observer.estimate(np.array(gains), seen[t], t * turning.time_step, kept))
            kept = observer.keep(seen[t], estimates[-1], u[t], kept)
        errors[kind] = float(np.sqrt(np.mean((np.array(estimates)[5:, 2:] - x[5:, 2:]) ** 2)))
    assert errors["filter"] < 0.9 * errors["none"]
    assert errors["derivative"] < 0.7 * errors["none"]
    assert errors["model"] < 0.3 * errors["none"]


def test_a_switched_policy_needs_a_goal_about_all_states(cartpole: Study) -> None:
    task = construct({**CARTPOLE, "goal": {"position": "sin(t)"}, "failure": None}, Task, "task")
    with pytest.raises(ValueError, match="goal has to be about all states"):
        Switched(task, cartpole.nominal)
