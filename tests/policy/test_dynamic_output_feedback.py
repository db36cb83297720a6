"""Feedback with memory against what theory says of each of its parts, and compiled against plain."""

import numpy as np
import pytest
from interpreted import assert_alike, interpreted

import simbias
from simbias.core import Quantity, Task
from simbias.core.records import Array, Disturbance
from simbias.learning.bias.none import ZeroBias
from simbias.policy.dynamic_output_feedback import DynamicOutputFeedback
from simbias.policy.output_feedback import OutputFeedback
from simbias.simulation.closed_loop import simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.numpy_loop import PlainSimulator

DT = 0.001  # s


class Cart(Task):
    """A position and a velocity, both outputs, and a force."""

    states = (Quantity("position", "m"), Quantity("velocity", "m/s"))
    outputs = states
    inputs = (Quantity("force", "N"),)
    criteria = ()
    time_step = DT
    horizon = 1000

    def __init__(self, limit: float = 1e6, time_step: float = DT) -> None:
        self.input_limit, self.time_step = np.array([limit]), time_step

    def measure(self, x: Array) -> Array:
        return np.zeros((*x.shape[:-1], 0))

    def output(self, x: Array) -> Array:
        return x


def hat(*gains: float) -> list[float]:
    """h-hat of gains (Eq. 10)."""
    return [float(np.sign(h) * np.log1p(abs(h))) for h in gains]


def inputs(policy: DynamicOutputFeedback, theta: list[float], states: Array) -> Array:
    """What the policy's control loop answers to states (k, n)."""
    controller = policy.controller(np.array(theta), DT)
    return np.array([controller(x)[0] for x in states])


def test_the_filters_step_response_is_that_of_its_time_constant() -> None:
    policy = DynamicOutputFeedback(Cart(), filter_seconds=0.1)
    tau, frames = 0.02, np.arange(1, 101)
    rates = inputs(policy, [*hat(0.0, 1.0), tau], np.tile([0.0, 1.0], (100, 1)))
    np.testing.assert_allclose(rates, 1.0 - np.exp(-frames * DT / tau), rtol=1e-9)
    positions = inputs(policy, [*hat(1.0, 0.0), tau], np.tile([1.0, 0.0], (100, 1)))
    np.testing.assert_allclose(positions, 1.0)  # which are no rates
    unfiltered = inputs(policy, [*hat(0.0, 1.0), 0.0], np.tile([0.0, 1.0], (3, 1)))
    np.testing.assert_allclose(unfiltered, 1.0)


def rest_on_a_cart(theta: list[float], offset: float, limit: float = 1e6) -> Array:
    """Where (2,) a cart of 1 kg is after 30 s, pushed by an offset too."""
    dt = 0.02  # s
    policy = DynamicOutputFeedback(Cart(limit, dt), integral_rate=1.0)
    controller, (position, velocity) = policy.controller(np.array(theta), dt), (0.5, 0.0)
    for _ in range(1500):
        velocity += dt * (controller(np.array([position, velocity]))[0] + offset)
        position += dt * velocity
    return np.array([position, velocity])


@pytest.mark.slow
def test_the_integral_removes_a_constant_offset() -> None:
    """Without it, the cart rests at offset / stiffness; with a limited force, it does not wind up."""
    k, d, offset = 4.0, 4.0, 2.0
    without = rest_on_a_cart([*hat(-k, -d), 0.0], offset)
    np.testing.assert_allclose(without, [offset / k, 0.0], atol=1e-6)
    for limit in (1e6, 2.5):
        np.testing.assert_allclose(rest_on_a_cart([*hat(-k, -d), 0.5], offset, limit), 0.0, atol=1e-4)


def test_the_last_inputs_predict_a_delayed_state() -> None:
    """A velocity whose force comes d frames late: g = h B acts on where it will be, so the delay cancels."""
    delay, h, task = 50, -30.0, Cart()
    policy = DynamicOutputFeedback(task, delay_seconds=delay * DT)

    def velocities(theta: list[float], late_by: int) -> Array:
        controller = policy.controller(np.array(theta), DT)
        v, late, seen = 1.0, [0.0] * late_by, []
        for _ in range(400):
            seen.append(v)
            late.append(controller(np.array([0.0, v]))[0])
            v += DT * late.pop(0)
        return np.array(seen)

    prompt = velocities([*hat(0.0, h), 0.0], 0)
    late = velocities([*hat(0.0, h), h], delay)
    np.testing.assert_allclose(late[delay:], prompt[:-delay], atol=1e-12)
    assert abs(velocities([*hat(0.0, h), 0.0], delay)[-50:]).max() > 0.1  # which swings on without


ALL = ["filter_seconds=0.02", "integral_rate=1.0", "integrated=[x_p,alpha_f]", "delay_seconds=0.004"]
ALL += ["constant=0.1"]


@pytest.mark.slow
def test_written_rollouts_are_the_plain_ones() -> None:
    """With all of it off, it is output feedback."""
    settings = [f"policy.{each}" for each in ALL]
    study = simbias.load(["tracking=none", "task.horizon=100", "policy=dynamic_output_feedback", *settings])
    assert study.policy.state_size == 14
    rng = np.random.default_rng(2)
    noise = Disturbance(rng.normal(size=(100, 1)), 0.001 * rng.normal(size=(101, 6)))
    model = study.model(ZeroBias(6))
    compiled, plain = simulator(model, noise), PlainSimulator([model], [noise])
    assert isinstance(compiled, CompiledSimulator)
    thetas = np.array([[9, 5, -7, -2, -5, 0.003, 0.5, -20.0, 3.0], [3, 1, -3, 2, -8, 0.0, 0.0, 50.0, -4.0]])
    starts = np.array([study.task.start_mean, 0.5 * study.task.start_mean])
    with interpreted():
        written = compiled.rollouts(thetas, starts)
        assert compiled.rollouts(thetas[:0], starts[:0]) == []
    assert_alike(written, plain.rollouts(thetas, starts), 1e-7, 1e-10, of_inputs=1e-8)
    for each in written:
        assert (np.abs(each.inputs) == 100.0).any()  # at its limit, where the integral rests
    off, linear = DynamicOutputFeedback(study.task), OutputFeedback(study.task)
    np.testing.assert_array_equal(off.bounds, linear.bounds)
    theta, x = rng.uniform(-5, 5, (7, 5)), 0.1 * rng.normal(size=(7, 6))
    u, memory = off.act(theta, x, 0.0, np.zeros((7, off.state_size)))
    np.testing.assert_allclose(u, linear.act(theta, x, 0.0, np.zeros((7, 0)))[0], rtol=1e-12)
    assert not memory[:, 5:].any()
    with pytest.raises(ValueError, match="no output is called height"):
        DynamicOutputFeedback(study.task, integral_rate=1.0, integrated=["height"])


def test_it_imitates_its_own_inputs() -> None:
    """Of records of a law with an integral, a constant and a memory of inputs, the parameters come back."""
    policy = DynamicOutputFeedback(Cart(), integral_rate=1.0, delay_seconds=0.01, constant=1.0)
    states = np.random.default_rng(0).normal(size=(3, 50, 2))
    for rate in (0.0, 0.7):
        theta = np.array([*hat(-4.0, 2.0), rate, -30.0, 7.0])
        answers = np.array([inputs(policy, theta.tolist(), record) for record in states])[..., None]
        np.testing.assert_allclose(policy.imitating(states, answers), theta, rtol=1e-6, atol=1e-9)
    without = DynamicOutputFeedback(Cart(), integrated=["position", "velocity"])  # at no rate
    answers = states @ [[-4.0], [2.0]]
    np.testing.assert_allclose(without.imitating(states, answers), hat(-4.0, 2.0), rtol=1e-6)
