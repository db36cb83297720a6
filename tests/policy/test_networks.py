"""Policies that are not linear: their formulas, limits, observers and latency, compiled as they are."""

from dataclasses import replace

import numpy as np
import pytest
from errors import one_line
from hypothesis import given, settings
from hypothesis.strategies import floats, integers
from interpreted import assert_alike, interpreted
from mechanisms import CARTPOLE, declared
from models import with_values
from point_mass import PointMass, WithoutWind

import simbias
from simbias.core import Model, Policy, Task
from simbias.core.records import Array, Iteration, Rollout
from simbias.learning.identification.rig import Motor, Rig
from simbias.policy.network import Network
from simbias.policy.observer import (
    DISTURBANCE,
    ELSEWHERE,
    OBSERVERS,
    KalmanFilter,
    LookAhead,
    Measured,
    ModelObserver,
    Observer,
    ObserverKind,
)
from simbias.policy.switched import Switched
from simbias.policy.trajectory import Trajectory
from simbias.robots.none import NoNominal
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.goal import holding
from simbias.simulation.linearization import linearization
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole"])


@pytest.fixture(scope="module")
def turning() -> Task:
    """The cart-pole, whose angle wraps and which does not fail."""
    states = CARTPOLE["states"] | {"angle": {"unit": "rad", "mean": 0.3, "deviation": 0.1, "wraps": True}}
    return declared(states=states, failure=None, horizon=30)


def drawn(policy: Policy, count: int, scale: float = 0.3) -> Array:
    centre = np.mean(policy.bounds, axis=0)
    half = policy.bounds[1] - centre
    return centre + scale * np.random.default_rng(0).uniform(-half, half, (count, len(half)))


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


def test_an_input_without_a_limit_is_named_and_a_kalman_filter_bears_it() -> None:
    filters = []
    for limit in (1.0, np.inf):
        task = PointMass()
        task.input_limit = np.array([limit])
        filters.append(KalmanFilter(task, WithoutWind(task)))
    assert filters[1].frames_ahead == filters[0].frames_ahead == 0
    np.testing.assert_allclose(filters[1].gain, filters[0].gain)
    for make in (Network, Trajectory):
        with one_line("inputs.force has no limit", ValueError):
            make(task, WithoutWind(task))


def late(task: Task, study: Study, frames: float) -> Rig:
    """The cart-pole with a motor that is so many frames late."""
    rig = Rig(task, study.nominal, {"force": Motor(delay=task.time_step)}, {})
    return with_values(rig, **{"force.delay": frames * task.time_step})


def written(cartpole: Study, turning: Task, observer: ObserverKind) -> tuple[list[Rollout], list[Rollout]]:
    """Rollouts by the lanes' loop and by NumPy's."""
    policy: Policy = Network(turning, cartpole.nominal, errors=True, observer=observer)
    if observer in ("filter", "model", "kalman", "disturbance"):
        policy = Switched(turning, cartpole.nominal, "rbf", units=5, observer=observer)
        policy = policy.designed_on(late(turning, cartpole, 1.3))
    noise = Noise(turning, {"velocity_variance": 1e-4}).draw(np.random.default_rng(0))
    asked = drawn(policy, 2), np.array([[0.0, 3.0, 0.0, 1.0], [0.0, 0.02, 0.0, 0.0]])
    model = Model(turning, policy, cartpole.nominal, cartpole.bias.fit(cartpole.no_data))
    compiled, plain = CompiledSimulator.of(model, noise), PlainSimulator([model], [noise])
    assert compiled is not None
    return compiled.rollouts(*asked), plain.rollouts(*asked)


@pytest.mark.slow
def test_written_they_are_what_they_are_in_numpy(cartpole: Study, turning: Task) -> None:
    """With noise, and around a turn; most observers are a switched policy's. Kalman's look ahead.

    `test_moving.py` has a switched policy compiled.
    """
    with interpreted():
        made = [written(cartpole, turning, observer) for observer in OBSERVERS]
    for fast, slow in made:
        assert_alike(fast, slow, 1e-5, 1e-6, of_inputs=1e-4)


def test_it_switches_where_the_regulator_holds_and_not_at_once_back(cartpole: Study, turning: Task) -> None:
    with pytest.raises(ValueError, match="goal must be all states"):
        Switched(declared(goal={"position": "sin(t)"}, failure=None), cartpole.nominal)
    for elsewhere, words in (("0.3 * t", "goal moves"), ("1.0", "cannot hold the task's goal")):
        goal = {"position": "0", "angle": elsewhere, "d_position": "0", "d_angle": "0"}
        with pytest.raises(ValueError, match=words):
            Switched(declared(goal=goal, failure=None), cartpole.nominal)
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


def test_the_regulator_adds_what_holds_the_robot_at_the_goal() -> None:
    """A mass that is pulled by 2 N sags without, also one that was identified. It is cut off nowhere."""

    class Pulled(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return super().step(x, 1.6 + u + 0.1 * u**2)

    class Linear(WithoutWind):  # as the other is around -2 N, not around 0
        def step(self, x: Array, u: Array) -> Array:
            return super().step(x, 0.6 * (u + 2.0))

    task = PointMass()
    policy, model = Switched(task, Pulled(task)), Pulled(task)
    for each in (policy, Switched(task, WithoutWind(task), observer="kalman").designed_on(model)):
        x, kept, theta = np.array([0.05, 0.0]), np.zeros(each.state_size), np.zeros(each.n_parameters)
        for t in range(500):
            u, kept = each.act(theta, x, t * task.time_step, kept)
            x = model.step(x, u)
        np.testing.assert_allclose(x, 0.0, atol=1e-4)
    x, theta = np.random.default_rng(0).normal(0.0, 0.5, (2000, 2)), np.zeros(policy.n_parameters)
    inputs, kept = policy.act(theta, x, 0.0, np.zeros((len(x), policy.state_size)))
    regulated = inputs[kept[:, -1] == 1.0]
    assert 0.9 * task.input_limit < np.abs(regulated).max() < task.input_limit
    linear, _ = Switched(task, Linear(task)).act(theta, x, 0.0, np.zeros((len(x), policy.state_size)))
    np.testing.assert_allclose(inputs, linear, atol=1e-4)


def test_the_regulator_does_not_take_dry_friction_for_damping() -> None:
    class Rubbing(WithoutWind):
        def step(self, x: Array, u: Array) -> Array:
            return super().step(x, u - np.tanh(1e3 * x[..., 1:]))

        def without_dry_friction(self) -> WithoutWind:
            return WithoutWind(task)

    task, x = PointMass(), np.array([0.05, 0.1])
    sliding, rubbing = (Switched(task, model(task)) for model in (WithoutWind, Rubbing))
    theta = np.zeros(sliding.n_parameters)
    np.testing.assert_array_equal(*(each.act(theta, x, 0.0, np.zeros(1))[0] for each in (sliding, rubbing)))


def test_observers_know_rates_better_than_sensors(cartpole: Study, turning: Task) -> None:
    """Of a pole that falls, with measured rates that are noisy; around the turn, too."""
    rng, n = np.random.default_rng(0), 200
    x, u = np.zeros((n, 4)), np.zeros((n, 1))
    x[0, 1] = 0.3
    for t in range(n - 1):
        x[t + 1] = cartpole.nominal.step(x[t], u[t])
    seen = x + rng.standard_normal((n, 4)) * [1e-4, 1e-4, 2.0, 2.0]
    seen[:, 1] = (seen[:, 1] + np.pi) % (2 * np.pi) - np.pi
    errors, noise = {}, {"angle_variance": 1e-8, "position_variance": 1e-8, "velocity_variance": 4.0}
    for kind, make in OBSERVERS.items():
        observer = make(turning, cartpole.nominal, noise)
        gains = {"filter": [0.6], "derivative": [0.9], "model": [0.9, 0.1]}.get(kind, [])
        kept, estimates = np.zeros(observer.size), []
        for t in range(n):
            estimates.append(observer.estimate(np.array(gains), seen[t], t * turning.time_step, kept))
            kept = observer.keep(seen[t], estimates[-1], u[t], t * turning.time_step, kept)
        errors[kind] = float(np.sqrt(np.mean((np.array(estimates)[5:, 2:] - x[5:, 2:]) ** 2)))
    assert errors["filter"] < 0.9 * errors["none"]
    assert errors["derivative"] < 0.7 * errors["none"]
    assert errors["model"] < 0.3 * errors["none"]
    assert errors["kalman"] < 0.5 * errors["model"]  # nothing is searched
    assert errors["disturbance"] < 0.5 * errors["model"]


@settings(max_examples=5, deadline=None)
@given(wind=floats(0.1, 2.0), seed=integers(0, 2**32 - 1))
def test_a_steady_wind_that_the_model_lacks_is_estimated(wind: float, seed: int) -> None:
    """With late inputs, too: what is seen and what is predicted are the states. Without, both stay behind."""
    task, noise = PointMass(), {"velocity_variance": 1e-2, "position_variance": 1e-6}
    motor = Rig(task, WithoutWind(task), {"force": Motor(delay=0.1)}, {})
    model = with_values(motor, **{"force.delay": 2.0 * task.time_step})
    errors = []
    for disturbances in (False, True):
        observer = KalmanFilter(task, model, noise, disturbances)
        x, kept, hidden = np.zeros(2), np.zeros(observer.size), np.zeros(model.state_size)
        rng, met = np.random.default_rng(seed), list[Array]()
        for t in range(500):
            estimate = observer.estimate(np.empty(0), x, t * task.time_step, kept)
            met.append(observer.ahead(estimate, kept))
            off = np.abs([estimate - x, met[max(t - 2, 0)] - x])
            u = rng.uniform(-1.0, 1.0, 1)
            kept = observer.keep(x, estimate, u, t * task.time_step, kept)
            x, hidden = model.advance(x, u, hidden)
            x = x + wind * task.time_step * np.array([task.time_step / 2, 1.0])
        errors.append(off)
    behind, exact = errors
    assert (behind[:, 1] > 0.02 * wind).all()
    assert (exact < 1e-6).all()
    assert kept[-1] == pytest.approx(wind)
    with one_line("observer: .* so no disturbance is estimated", ValueError):
        KalmanFilter(task, NoNominal(task, kinematics=True), noise, True)


def test_the_kalman_filters_gain_is_where_its_covariance_settles(cartpole: Study, turning: Task) -> None:
    """By the recursion of the covariance, from that of the first measurement."""
    noise = {"velocity_variance": 4.0, "angle_variance": 1e-4, "position_variance": 1e-6}
    gain = KalmanFilter(turning, cartpole.nominal, noise).gain
    A, B = linearization(cartpole.nominal, np.zeros(4), np.zeros(1), turning.input_limit)
    V = np.diag(Noise(turning, noise).sensor_variance)
    W = (DISTURBANCE * turning.input_limit) ** 2 * B @ B.T
    W += ELSEWHERE**2 * np.diag(np.diag(W)) + 1e-12 * np.eye(4)
    P = V
    for _ in range(5000):
        before = A @ P @ A.T + W
        L = before @ np.linalg.inv(before + V)
        P = (np.eye(4) - L) @ before
    np.testing.assert_allclose(gain, L, rtol=1e-5, atol=1e-9)
    trusting = KalmanFilter(turning, cartpole.nominal).gain  # what is measured has no noise
    np.testing.assert_allclose(trusting @ np.eye(4), np.eye(4), atol=0.3)


@pytest.mark.slow
def test_a_kalman_filter_is_that_of_the_inputs_which_hold_the_robot() -> None:
    """As it pitches, a quadrotor moves sideways only while its rotors push, and they cannot pull."""
    study, hover = simbias.load(["preset=quadrotor_square"]), np.full(2, 4.905)
    task, model, noise = study.task, study.nominal, study.config["hardware"]["noise"]
    observer, rng = KalmanFilter(task, model, noise), np.random.default_rng(0)
    x, kept, errors = task.start_mean.copy(), np.zeros(observer.size), []
    x[3] = 0.3  # m/s
    for t in range(400):
        seen = x + np.sqrt(Noise(task, noise).sensor_variance) * rng.standard_normal(6)
        estimate = observer.estimate(np.empty(0), seen, t * task.time_step, kept)
        errors.append((estimate - x)[:3])
        u = hover + 0.2 * rng.standard_normal(2)
        kept, x = observer.keep(seen, estimate, u, t * task.time_step, kept), model.step(x, u)
    assert (np.sqrt(np.mean(np.square(errors[200:]), axis=0)) < 0.5 * 0.01).all()  # of what is measured


def test_with_targets_a_kalman_filter_is_that_of_the_mean_start(cartpole: Study) -> None:
    """A robot has no goal of its own; one upright at zero would be another."""
    targets = {"place": {"unit": "m", "uniform": [0.1, 0.5]}}
    task = declared(targets=targets, goal={"position": "place"}).without_targets
    task.start_mean = np.array([0.2, 0.3, 0.0, 0.0])
    x, _ = KalmanFilter(task, cartpole.nominal)._balance()
    np.testing.assert_array_equal(x, task.start_mean)
    assert task.error(x, 0.0).shape == (0,)


@pytest.mark.slow
def test_where_inputs_cannot_hold_the_robot_they_do_their_best() -> None:
    """One rotor too weak to hover: the other pushes less, too, as the quadrotor would turn."""
    study = simbias.load(["preset=quadrotor_square", "task.inputs.right.limit=5.0"])
    observer = KalmanFilter(study.task, study.nominal)
    x, u = observer._balance()
    near = u + np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    within = near[(near >= [1.2, 0.5]).all(axis=1) & (near <= [10.8, 4.5]).all(axis=1)]
    changes = np.linalg.norm(study.nominal.step(np.tile(x, (len(within), 1)), within) - x, axis=1)
    assert len(within) > 50
    assert np.linalg.norm(study.nominal.step(x, u) - x) <= changes.min()


def test_a_kalman_filter_knows_late_inputs_and_what_the_next_one_will_meet(
    cartpole: Study, turning: Task
) -> None:
    """Without noise: its predictions are the states, and it looks ahead by the delay."""
    motor, rng, frames = late(turning, cartpole, 2.0), np.random.default_rng(0), 30
    observer = KalmanFilter(turning, cartpole.nominal).designed_on(motor)
    assert observer.frames_ahead == 2
    assert KalmanFilter(turning, cartpole.nominal).frames_ahead == 0
    assert KalmanFilter(turning, NoNominal(turning, kinematics=True)).frames_ahead == 0
    u = rng.uniform(-30.0, 30.0, (frames, 1))
    x, hidden = np.zeros((frames + 1, 4)), np.zeros(motor.state_size)
    x[0, 1] = 0.2
    for t in range(frames):
        x[t + 1], hidden = motor.advance(x[t], u[t], hidden)
    kept = np.zeros(observer.size)
    for t in range(frames - 2):
        estimate = observer.estimate(np.empty(0), x[t], t * turning.time_step, kept)
        np.testing.assert_allclose(estimate, x[t], atol=1e-9)
        np.testing.assert_allclose(observer.ahead(estimate, kept), x[t + 2], atol=1e-9)
        kept = observer.keep(x[t], estimate, u[t], t * turning.time_step, kept)
        np.testing.assert_allclose(kept[:4], x[t + 1], atol=1e-9)


def test_the_policy_that_runs_is_that_of_the_model(cartpole: Study, turning: Task) -> None:
    """Of an identified one, if it has a Kalman filter; else it stays as it is."""
    other = late(turning, cartpole, 1.0)
    for make in (Network, Switched):
        plain = make(turning, cartpole.nominal)
        assert plain.designed_on(other) is plain
        study = replace(cartpole, policy=make(turning, cartpole.nominal, observer="kalman"))
        model = study.model(None, other)
        assert model.policy is not study.policy
        assert study.designed_on(model).policy is model.policy
        assert study.designed_on(study.model()) is study
        assert model.policy.state_size == study.policy.state_size + other.state_size
        last = Iteration(0, np.zeros(study.policy.n_parameters), (), 0.0, True, 0, model)
        trial = TrialRecord(study, TrialSummary(Outcome.SUCCEEDED), (last,))
        assert trial.next_experiment.policy is model.policy


BOARD = ["preset=acrobot_board", "policy.latency=0", "policy.input_weight=100", "tracking=none"]


@pytest.mark.parametrize("delay", [1.5, 2.0, 2.7])
def test_what_the_next_input_does_meanwhile_is_what_holds_the_robot(delay: float) -> None:
    """A quadrotor that hovers is not seen to fall, by whatever share of a frame its rotors are late."""
    study = simbias.load(["preset=quadrotor_square", "tracking=none"])
    task, motor = study.task, Motor(delay=0.02)
    late = {f"{u.name}.delay": delay * task.time_step for u in task.inputs}
    rig = with_values(Rig(task, study.nominal, {u.name: motor for u in task.inputs}, {}), **late)
    observer, hover = KalmanFilter(task, rig), holding(task, study.nominal, np.zeros(6))
    kept = np.zeros(observer.size)
    for t in range(10):
        estimate = observer.estimate(np.empty(0), np.zeros(6), t * task.time_step, kept)
        ahead = observer.ahead(estimate, kept)
        kept = observer.keep(np.zeros(6), estimate, hover, t * task.time_step, kept)
    np.testing.assert_allclose(ahead, 0.0, atol=1e-6)


@pytest.mark.parametrize("observer", [KalmanFilter, ModelObserver])
def test_late_measurements_are_predicted_by_the_inputs_of_their_time(observer: type[Observer]) -> None:
    """Without noise, an exact model leaves nothing to correct, whatever the gains."""
    task, rng, late = PointMass(), np.random.default_rng(0), 4
    model = WithoutWind(task)
    ahead = LookAhead(task, model, observer(task, model), late * task.time_step)
    x, kept = [np.array([0.5, 0.0])] * (late + 1), np.zeros(ahead.size)
    for t in range(30):
        estimate = ahead.estimate(np.full(len(ahead.bounds[0]), 0.05), x[t], t * task.time_step, kept)
        np.testing.assert_allclose(estimate, x[t], atol=1e-12)
        u = rng.uniform(-5.0, 5.0, 1)
        x.append(model.step(x[-1], u))
        kept = ahead.keep(x[t], estimate, u, t * task.time_step, kept)


def test_errors_are_those_of_the_goal_when_inputs_act() -> None:
    """A state that is predicted three frames ahead is compared with the goal of that time."""
    task = declared(goal={"position": "0.1 * t", "d_position": "0.1"})
    late = 3 * task.time_step
    model = NoNominal(task, kinematics=True)
    ahead, plain = (Network(task, model, errors=True, latency=seconds) for seconds in (late, 0.0))
    theta, x = drawn(plain, 1)[0], np.array([0.0, 0.1, 0.1, 0.0])  # it stays this fast
    met = ahead.ahead(x, np.zeros(ahead.state_size))
    np.testing.assert_allclose(met, x + late * np.array([0.1, 0.0, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(ahead.ask(theta, met, 0.0), plain.ask(theta, met, late), atol=1e-12)


def board(*overrides: str) -> Study:
    return simbias.load([*BOARD, *overrides])


@pytest.mark.slow
def test_it_sees_most_of_what_happens_while_measurements_are_late() -> None:
    """Four frames late: of what moves in them a tenth is missed, by one step of the model."""
    study, rng = board(), np.random.default_rng(0)
    task, nominal = study.task, study.nominal
    observer = LookAhead(task, nominal, Measured(task, nominal), 4 * task.time_step)
    missed = []
    for _ in range(20):
        path = [rng.normal(0.0, [1.0, 1.0, 3.0, 3.0])]
        kept, u = np.zeros(observer.size), rng.uniform(-2.0, 2.0, (4, 1))
        for each in u:
            kept = observer.keep(path[0], path[0], each, 0.0, kept)
            path.append(nominal.step(path[-1], each))
        wrong = observer.ahead(observer.estimate(np.empty(0), path[0], 1.0, kept), kept) - path[-1]
        missed.append(np.linalg.norm(wrong) / np.linalg.norm(path[-1] - path[0]))
    assert np.median(missed) < 0.1
    assert max(missed) < 0.5


def tip(study: Study, late: int) -> Array:
    """How far (t,) an acrobot that begins near the top is from it, when measurements are some frames late."""
    theta = np.append(np.zeros(study.policy.n_parameters - 1), 3.0)  # its regulator, wherever it is
    theta[-2] = 1.0  # rates as positions tell them
    states, kept = [np.array([0.002, 0.0, 0.0, 0.0])], np.zeros(study.policy.state_size)
    for t in range(400):
        measured = states[max(t - late, 0)]
        u, kept = study.policy.act(theta, measured, t * study.task.time_step, kept)
        states.append(study.nominal.step(states[-1], u))
    return np.abs(np.array(states)).max(axis=1)


@pytest.mark.slow
def test_a_regulator_bears_later_measurements() -> None:
    plain, ahead = board(), board("policy.latency=0.016")
    assert tip(plain, 0)[-50:].max() < 0.03
    assert tip(plain, 6)[-50:].max() > 1.0  # 24 ms
    assert tip(ahead, 6)[-50:].max() < 0.03
    assert tip(ahead, 0)[-50:].max() < 0.03  # nor do they have to be late


def test_what_cannot_be_is_one_line() -> None:
    """To be later than it can remember, or to leave a regulator before it takes over."""
    for option, words in (
        ("latency=0.1", r"latency: expected at most 20 frames, 0\.08 s, got 0\.1 s"),
        ("hysteresis=0.9", r"policy\.hysteresis: .*greater than or equal to 1"),
    ):
        with one_line(words):
            board(f"policy.{option}")
