"""Policies that imitate LQR, and LQI, against what theory says of rests, of gains, and of closed loops."""

from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from models import with_values
from point_mass import PointMass, WithoutWind

import simbias
from simbias.core import Model, Nominal, Policy, Quantity, StudyWarning
from simbias.core.errors import ConfigError
from simbias.core.parameters import values_at
from simbias.core.records import Array
from simbias.learning.bias.none import ConstantBias, ZeroBias
from simbias.learning.identification.identified import Identified
from simbias.policy.dynamic_output_feedback import DynamicOutputFeedback
from simbias.policy.gains import signed_exponential
from simbias.policy.integral_feedback import IntegralFeedback
from simbias.policy.output_feedback import OutputFeedback
from simbias.search.lqr import INPUT_WEIGHTS, linearised, lqr_candidates, lqr_gains, lqr_policies, rest
from simbias.simulation.goal import resting_goal
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.run import run_trial
from simbias.trial.study import Study

SLOPE = ["nominal.uncertainty.slope=0.025", "task.outputs=states"]
DELAY = ["nominal.uncertainty.delay=0.02", "task.outputs=states"]
PAYLOAD = ["nominal.uncertainty.payload_mass=3.0", "nominal.uncertainty.payload_x=0.1"]
CONSTANT = ["policy=dynamic_output_feedback", "policy.constant=5.0"]


def bongoboard(*overrides: str, **values: float) -> tuple[Study, Model]:
    """A study, and its model with other values of its parameters."""
    study = simbias.load(["tracking=none", "bias=none", *overrides])
    return study, study.model(None, with_values(study.nominal, **values))


def point_mass(dynamics: type[WithoutWind] = WithoutWind, policy: type[Policy] = OutputFeedback) -> Model:
    """A mass that a force moves."""
    task = PointMass()
    return Model(task, policy(task), dynamics(task), ZeroBias(2))


def test_a_robot_rests_where_nothing_accelerates() -> None:
    """On a slope it leans; of its many rests, it is one near zero."""
    _, model = bongoboard(*SLOPE, slope=0.05)
    x, u = rest(model)
    np.testing.assert_allclose(model.nominal.accelerations(x, u), 0.0, atol=1e-2)
    np.testing.assert_allclose(x[3:], 0.0, atol=1e-5)
    assert 0.01 < np.abs(x).max() < 0.2


def test_an_input_without_a_limit_weighs_as_one_of_a_unit() -> None:
    policies = []
    for limit in (1.0, np.inf):
        model = point_mass()
        model.task.input_limit = np.array([limit])
        policies.append(lqr_policies(model))
    assert len(policies[0]) == len(INPUT_WEIGHTS)
    np.testing.assert_allclose(*policies, rtol=1e-9)


def test_a_bias_moves_the_rest() -> None:
    """A steady wind of 2 N, as a bias, is what the force has to balance."""
    dt = 0.02
    wind = ConstantBias(2.0 * dt * np.array([dt, 1.0]), np.zeros(2))
    x, u = rest(replace(point_mass(), bias=wind))
    assert u == pytest.approx(-2.0, abs=1e-3)
    np.testing.assert_allclose(x, 0.0, atol=1e-3)


class Elsewhere(PointMass):
    """To be held at a place in m; a policy sees the errors of that, if at all."""

    def __init__(self, errors: bool, place: float = 0.3) -> None:
        super().__init__()
        self._errors, self._place = errors, place

    def reference(self, t: Any, targets: Array | None = None) -> Array:
        return np.array([self._place, 0.0])

    def output(self, x: Array) -> Array:
        return self.error(x, 0.0) if self._errors else x.copy()


@pytest.mark.parametrize("errors", [True, False])
def test_the_rest_is_at_a_goal_that_is_not_zero(errors: bool) -> None:
    """A policy of errors regulates to it, one with a constant too; others are told, and regulate to zero."""
    task = Elsewhere(errors)
    model = replace(point_mass(), task=task, policy=OutputFeedback(task))
    constant = replace(model, policy=DynamicOutputFeedback(task, constant=5.0))
    with (
        nullcontext()
        if errors
        else pytest.warns(StudyWarning, match="OutputFeedback cannot hold the goal as LQR does")
    ):
        policies = lqr_policies(model)
    np.testing.assert_allclose(policies, lqr_policies(point_mass()), rtol=1e-6)
    (theta, *_) = lqr_policies(constant)
    end = PlainSimulator([constant], [None]).rollout(theta, task.start_mean).states[-1]
    np.testing.assert_allclose(end, [0.3, 0.0], atol=0.06)
    integral = replace(model, policy=IntegralFeedback(task))
    with nullcontext() if errors else pytest.warns(StudyWarning, match="it integrates outputs that are not"):
        lqr_policies(integral, integral_weight=1.0)


@pytest.mark.parametrize(("goal", "spring_at"), [(0.3, 0.0), (0.8, 0.0), (0.0, -0.8)])
def test_a_goal_is_held_against_a_spring(goal: float, spring_at: float) -> None:
    """The input that this takes is no reason to rest elsewhere."""

    class Sprung(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return super().step(x, u - 4.0 * (x[..., :1] - spring_at))

    task = Elsewhere(errors=True, place=goal)
    task.horizon = 1000
    held = DynamicOutputFeedback(task, constant=5.0)
    model = replace(point_mass(), task=task, nominal=Sprung(task), policy=held)
    (theta, *_) = lqr_policies(model)
    end = PlainSimulator([model], [None]).rollout(theta, task.start_mean).states[-1]
    np.testing.assert_allclose(end, [goal, 0.0], atol=0.02)


WIND = ConstantBias(2.0 * 0.02 * np.array([0.02, 1.0]), np.zeros(2))  # of 2 N


def test_a_steady_input_is_the_constants_or_the_integrals() -> None:
    """It enters no gain: a policy without a constant has those of calm air, and is said to rest elsewhere."""
    task = Elsewhere(errors=True)
    windy = replace(point_mass(), task=task, bias=WIND)
    constant = replace(windy, policy=DynamicOutputFeedback(task, constant=5.0))
    (theta, *_) = lqr_policies(constant)
    end = PlainSimulator([constant], [None]).rollout(theta, task.start_mean).states[-1]
    np.testing.assert_allclose(end, [0.3, 0.0], atol=0.06)
    without, integral = (replace(windy, policy=policy(task)) for policy in (OutputFeedback, IntegralFeedback))
    with pytest.warns(StudyWarning, match="OutputFeedback has no constant .* so it rests elsewhere"):
        policies = lqr_policies(without)
    np.testing.assert_allclose(policies, lqr_policies(point_mass()), rtol=1e-5)
    (theta, *_) = lqr_policies(integral, integral_weight=1.0)
    calm = replace(integral, bias=ZeroBias(2))
    np.testing.assert_allclose(theta, lqr_policies(calm, integral_weight=1.0)[0], rtol=1e-5)


class Aimed(Elsewhere):
    """A goal about the position alone, or about an output of it, which is nowhere among the states."""

    goals = PointMass.states[:1]

    def __init__(self, scale: float) -> None:
        super().__init__(errors=True)
        self._scale = scale

    def aim(self, x: Array) -> Array:
        return self._scale * x[..., :1]

    def reference(self, t: Any, targets: Array | None = None) -> Array:
        return np.array([0.3])


def test_goals_are_placed_among_the_states_and_those_of_outputs_are_told() -> None:
    np.testing.assert_array_equal(resting_goal(Aimed(1.0)), [0.3, 0.0])
    with pytest.warns(StudyWarning, match=r"regulates to zero, because the goal is for outputs \(position\)"):
        assert resting_goal(Aimed(2.0)) is None


@pytest.mark.parametrize("seconds", [1.0, 1e5])
def test_a_slow_process_rests_at_its_goal(seconds: float) -> None:
    """Its frames are as slow as it is."""

    class Leaking(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return 0.98 * x + self._dt * u

    task = Elsewhere(errors=True)
    task.time_step, task.input_limit = 0.02 * seconds, np.array([1.0 / seconds])
    model = replace(point_mass(), task=task, nominal=Leaking(task))
    linear = linearised(model, np.array([0.3, 0.3]))
    np.testing.assert_allclose(model.nominal.step(linear.rest, linear.inputs), linear.rest, rtol=1e-6)


def test_a_late_model_is_regulated_with_its_memory() -> None:
    """Twenty inputs that are under way count as states; without them the loop would be unstable."""
    study, model = bongoboard(*DELAY, delay=0.02)
    linear = linearised(model)
    assert linear.A.shape == (6 + model.nominal.state_size,) * 2
    K = lqr_gains(linear, 100.0 * np.diag(study.task.input_limit**-2.0))
    blind = np.where(np.arange(len(linear.A)) < 6, K, 0.0)
    radius, without = (np.abs(np.linalg.eigvals(linear.A - linear.B @ gains)).max() for gains in (K, blind))
    assert radius < 1.0 < without


def test_a_policy_of_the_state_is_lqr_itself() -> None:
    model, dt = point_mass(), 0.02
    linear = linearised(model)
    np.testing.assert_allclose(linear.A, [[1.0, dt], [0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(linear.B, [[dt**2], [dt]], atol=1e-9)
    theta, *_ = lqr_policies(model)
    K = lqr_gains(linear, np.diag(10.0 * model.task.input_limit**-2.0))
    np.testing.assert_allclose(signed_exponential(theta), -K[0], rtol=1e-6)


def test_what_has_no_lqr_has_no_policies_and_searches_say_so() -> None:
    """A model that no input moves, one that is not finite, and policies that imitate nothing."""

    class Stuck(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return 1.5 * x

    class Burst(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return np.nan * x

    class Other(OutputFeedback):  # type: ignore[misc]
        def imitating(self, states: Array, inputs: Array) -> None:
            return None

    class Gain(Policy):
        """u = theta x, without `imitating`."""

        def __init__(self, task: PointMass) -> None:
            self.n_parameters, self.bounds = 2, (np.full(2, -5.0), np.full(2, 5.0))

        def act(self, theta: Array, x: Array, t: float, memory: Array) -> tuple[Array, Array]:
            return np.sum(theta * x, axis=-1, keepdims=True), memory

    for model in (point_mass(Stuck), point_mass(Burst), point_mass(policy=Other)):
        assert lqr_policies(model) == []
    with pytest.warns(StudyWarning, match="begin without LQR: Gain imitates none"):
        assert list(lqr_candidates(point_mass(policy=Gain), 3)) == []
    assert list(lqr_candidates(point_mass(policy=Gain), 0)) == []
    to_a_target = point_mass()
    to_a_target.task.targets = (Quantity("place", "m"),)
    with pytest.warns(StudyWarning, match="begin without LQR: targets need another regulator at each start"):
        assert list(lqr_candidates(to_a_target, 3)) == []


@pytest.mark.slow
def test_other_models_are_drawn_and_the_same_each_time() -> None:
    _, model = bongoboard(*DELAY)
    once, again = (list(lqr_candidates(model, 2)) for _ in range(2))
    assert len(once) == 2 * len(INPUT_WEIGHTS)
    np.testing.assert_array_equal(once, again)
    np.testing.assert_array_equal(once[: len(INPUT_WEIGHTS)], lqr_policies(model))
    assert not np.allclose(once[0], once[len(INPUT_WEIGHTS)])
    assert list(lqr_candidates(model, 0)) == []


@pytest.mark.slow
def test_one_of_them_balances_where_searches_find_none(uncompiled: None) -> None:
    """From eight starts, four times as long as it takes to fall; with the gap known."""
    for overrides, values in (
        ([*SLOPE, *CONSTANT], {"slope": 0.02}),
        ([*DELAY, *CONSTANT, "policy.delay_seconds=0.02"], {"delay": 0.02}),
        ([*PAYLOAD, *CONSTANT, "task.outputs=states"], {"payload_mass": 6.0, "payload_x": 0.1}),
    ):
        study, model = bongoboard(*overrides, "task.horizon=500", **values)
        assert any(held(study, model.nominal, theta) == 8 for theta in lqr_policies(model)), values


def held(study: Study, nominal: Nominal, theta: Array) -> int:
    """How many of eight starts a policy holds in simulation."""
    rng = np.random.default_rng(1)
    starts = np.array([study.task.draw_start(rng) for _ in range(8)])
    rollouts = study.simulator(None, nominal).rollouts(np.tile(theta, (8, 1)), starts)
    return sum(rollout.failure is None for rollout in rollouts)


@pytest.mark.slow
def test_dry_friction_is_no_damping_to_count_on(uncompiled: None) -> None:
    """Regulators of the acrobot that were designed for it as it sticks fall, simulated with that friction."""
    study = simbias.load(["preset=acrobot", "bias=none", "tracking=none"])
    nominal = with_values(study.nominal, friction_1=0.02, friction_2=0.02)  # N m
    sliding, sticking = (
        lqr_policies(study.model(None, nominal), (100.0,), sticking=each)[0] for each in (False, True)
    )
    assert held(study, nominal, sliding) >= 7
    assert held(study, nominal, sticking) == 0


MOTOR = "identification.motors={torque: {velocity: d_angle_2, stribeck: 0.1, load: 0.1}}"


DRY = {
    ("nominal.uncertainty.ankle_friction=5",): ["ankle_friction"],
    ("preset=pendulum_swingup", "nominal=pendulum"): ["hinge.friction"],
    ("preset=acrobot", MOTOR): ["friction_1", "friction_2", "torque.stribeck", "torque.load"],
}


@pytest.mark.slow
def test_without_dry_friction_all_else_stays() -> None:
    for overrides, dry in DRY.items():
        study, rng = simbias.load([*overrides, "tracking=none"]), np.random.default_rng(0)
        nominal, task = study.first_model().nominal, study.task
        values = values_at(nominal.parameters, rng.standard_normal(len(nominal.parameters)))
        smooth = np.where([each.name in dry for each in nominal.parameters], 0.0, values)
        assert np.sum(smooth != values) == len(dry), dry
        x, u = 0.1 * rng.normal(size=(5, len(task.states))), rng.normal(size=(5, len(task.inputs)))
        expected = nominal.with_parameters(smooth).step(x, u)
        made = nominal.with_parameters(values).without_dry_friction().step(x, u)
        np.testing.assert_array_equal(made, expected)
        at = Identified(nominal, rng.standard_normal(len(values)), np.eye(len(values)), {})
        assert np.any(at.without_dry_friction().step(x, u) != at.step(x, u)), dry


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


@pytest.mark.slow
def test_what_cannot_be_is_named(cartpole: Study) -> None:
    lqi = simbias.load(["method=lqi", "tracking=none"])
    with pytest.raises(ConfigError, match=r"^method: OutputFeedback integrates nothing; .*integral_rate"):
        run_trial(lqi)  # before it begins
    for method, key in (("lqr", "method"), ("direct_search_lqr", r"method\.begin")):
        moving = simbias.load(["preset=reacher", "~method.target_cost", "tracking=none", f"method={method}"])
        with pytest.raises(ConfigError, match=f"^{key}: targets need another regulator at each start"):
            moving.method.check(moving)
    with pytest.raises(ValueError, match=r"^outputs: none is called speed; available: position"):
        IntegralFeedback(cartpole.task, outputs=["speed"])
