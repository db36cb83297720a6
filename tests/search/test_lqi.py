"""Regulators with an integral."""

import numpy as np
import pytest

import simbias
from simbias.core import Nominal
from simbias.core.errors import ConfigError
from simbias.core.records import Array
from simbias.policy.integral_feedback import IntegralFeedback
from simbias.search.lqr import lqr_policies
from simbias.trial.run import run_trial
from simbias.trial.study import Study


class Pushed(Nominal):
    """A model on whose input something leans."""

    def __init__(self, nominal: Nominal, push: float) -> None:
        self._nominal, self._push = nominal, push

    def step(self, x: Array, u: Array) -> Array:
        return self._nominal.step(x, u + self._push)


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole", "policy=integral_feedback", "tracking=none"]).with_horizon(400)


@pytest.mark.slow
def test_a_steady_disturbance_leaves_no_error(cartpole: Study, uncompiled: None) -> None:
    """The model is not told of it; without the integral the cart stays aside."""
    pushed = Pushed(cartpole.nominal, 5.0)
    ends = []
    for weight in (0.0, 10.0):
        (theta,) = lqr_policies(cartpole.model(), (100.0,), weight)
        rollout = cartpole.simulate(theta, start=np.zeros(4), nominal=pushed)
        assert rollout.failed_at is None
        ends.append(abs(rollout.states[-1, 0]))
    assert ends[0] > 0.03
    assert ends[1] < 0.1 * ends[0]


def test_parameters_are_those_that_are_imitated(cartpole: Study) -> None:
    policy = IntegralFeedback(cartpole.task, outputs=["position", "angle"])
    rng = np.random.default_rng(0)
    theta, states = rng.normal(size=policy.n_parameters), 1e-3 * rng.normal(size=(3, 40, 4))
    memory, inputs = np.zeros((3, 2)), np.empty((3, 40, 1))
    for t in range(40):
        inputs[:, t], memory = policy.act(theta, states[:, t], 0.0, memory)
    np.testing.assert_allclose(policy.imitating(states, inputs), theta, atol=1e-6)


def test_the_integral_rests_at_the_limit(cartpole: Study) -> None:
    policy, x = IntegralFeedback(cartpole.task), np.array([0.1, 0.0, 0.0, 0.0])
    theta = np.array([9.0, 0.0, 0.0, 0.0, 1.0])
    u, memory = policy.act(theta, x, 0.0, np.zeros(1))
    assert (u[0], memory[0]) == (cartpole.task.input_limit[0], 0.0)
    _, memory = policy.act(0.1 * theta, x, 0.0, np.zeros(1))
    assert memory[0] == pytest.approx(0.1 * cartpole.task.time_step)


def test_what_cannot_be_is_named(cartpole: Study) -> None:
    lqi = simbias.load(["method=lqi", "tracking=none"])
    with pytest.raises(ConfigError, match=r"^method: OutputFeedback imitates no LQI"):
        run_trial(lqi)  # before it begins
    with pytest.raises(ValueError, match=r"^outputs: none is called speed; there are position"):
        IntegralFeedback(cartpole.task, outputs=["speed"])
