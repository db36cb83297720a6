"""A policy that follows a trajectory: its formula, and its table wherever it is looked up."""

import numpy as np
import pytest
from interpreted import interpreted
from mechanisms import declared
from models import with_values

import simbias
from simbias.core import Model
from simbias.core.records import Array
from simbias.lab.requests.folder import files
from simbias.lab.requests.request import HEADER, MODULE, ExperimentRequest
from simbias.learning.identification.rig import Motor, Rig
from simbias.policy.trajectory import Trajectory
from simbias.search.lqr import linearised, lqr_gains
from simbias.simulation.closed_loop import join, simulator
from simbias.simulation.compiler import scheduled
from simbias.simulation.compiler.tracing import parts_of
from simbias.simulation.noise import Noise
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.study import Study

KNOTS = 11


@pytest.fixture(scope="module")
def cartpole() -> Study:
    return simbias.load(["preset=cartpole", "bias=none", "tracking=none", "task.horizon=100"])


def around(study: Study, count: int, knots: int = KNOTS) -> tuple[Trajectory, Array]:
    """Policies (count, p) that balance, about trajectories of small random steps."""
    rng, gains = np.random.default_rng(0), lqr_gains(linearised(study.model()), np.array([[1e-3]]))
    assert gains is not None
    policy = Trajectory(study.task, study.nominal, knots)
    thetas = [
        policy.following(
            0.01 * rng.standard_normal((knots, 4)),
            rng.standard_normal((knots, 1)),
            gains * rng.uniform(0.9, 1.1, (knots, 1, 4)),
        )
        for _ in range(count)
    ]
    return policy, np.array(thetas)


def test_a_table_is_linear_between_its_rows_and_ends_with_the_last() -> None:
    table = np.array([[[0.0, 1.0], [2.0, 1.0], [3.0, -1.0]]])
    for t, row in ((0.0, [0, 1]), (0.25, [1, 1]), (0.75, [2.5, 0]), (1.0, [3, -1]), (9.0, [3, -1])):
        np.testing.assert_allclose(scheduled(table, t, 0.5), [row])


def test_the_input_is_feedforward_and_gains_at_that_time(cartpole: Study) -> None:
    policy, (theta,) = around(cartpole, 1)
    rows, x = theta.reshape(KNOTS, 9), np.array([0.01, -0.02, 0.03, 0.04])
    spacing = policy.times[1]
    assert policy.times[-1] == cartpole.task.horizon * cartpole.task.time_step
    for t, row in ((0.0, rows[0]), (2.5 * spacing, (rows[2] + rows[3]) / 2), (99.0, rows[-1])):
        u, _ = policy.act(theta, x, t, np.empty(0))
        assert u == pytest.approx(row[4:5] - row[5:] @ (x - row[:4]))
    beyond, _ = policy.act(theta, x + 9.0, 0.0, np.empty(0))
    assert abs(beyond) == cartpole.task.input_limit


def test_feedforward_is_within_the_tasks_limits_however_large(cartpole: Study) -> None:
    task = declared(inputs={"force": {"unit": "N", "limit": 5e4}})
    rows = Trajectory(task, cartpole.nominal, KNOTS, bound=2.0).bounds[1].reshape(KNOTS, 9)
    np.testing.assert_array_equal(rows[:, 4:], np.tile([5e4, *[1e5] * 4], (KNOTS, 1)))


def test_gains_for_friction_are_cut_off_at_a_tenth_of_the_limits(cartpole: Study) -> None:
    policy = Trajectory(cartpole.task, cartpole.nominal, KNOTS, sliding=True)
    nothing = np.zeros((KNOTS, 5))
    K, L = np.tile([1.0, 2.0, 3.0, 4.0], (KNOTS, 1, 1)), np.tile([0.0, 500.0, 0.0, 0.0], (KNOTS, 1, 1))
    theta = policy.following(nothing[:, :4], nothing[:, :1], K, L)
    assert theta.shape == (policy.n_parameters,)
    most = 0.1 * cartpole.task.input_limit
    for angle, beside in ((0.01, -5.0), (-0.01, 5.0), (0.5, -most)):
        u, _ = policy.act(theta, np.array([0.0, angle, 0.0, 0.0]), 0.0, np.empty(0))
        assert u == pytest.approx(-2.0 * angle + beside)


def test_the_law_says_what_x_is_and_what_wraps(cartpole: Study) -> None:
    _, (theta,) = around(cartpole, 1)
    swing_up = simbias.load(["preset=cartpole_trajectory", "tracking=none"])
    for study, observer, said in (
        (cartpole, "none", "K_t"),
        (cartpole, "kalman", "; x as KalmanFilter estimates it"),
        (swing_up, "none", "; angle within half a turn of x_t"),
    ):
        policy = Trajectory(study.task, study.nominal, KNOTS, observer=observer)
        assert policy.law(theta).words.endswith(said)


@pytest.mark.slow
def test_a_filter_that_diverges_where_no_robot_is_keeps_nothing_from_being_compiled() -> None:
    """States farther than any robot's amplify what is rounded, in NumPy as in what is written down."""
    noise = "policy.noise={velocity_variance: 0.01, angle_variance: 1e-4}"
    options = [
        "preset=cartpole_trajectory",
        "tracking=none",
        "policy.observer=kalman",
        "policy.sliding=true",
        noise,
    ]
    assert [part.why_not for part in parts_of(simbias.load(options).first_model())] == [""] * 4


@pytest.mark.slow
def test_written_it_is_what_it_is_in_numpy(cartpole: Study) -> None:
    """With noise; in lanes that are at different times, as rollouts end and others begin."""
    policy, thetas = around(cartpole, 24)
    thetas[::3, 8::9] *= -1.0  # these fall
    starts = np.array([cartpole.task.draw_start(np.random.default_rng(i)) for i in range(len(thetas))])
    noise = Noise(cartpole.task, {"velocity_variance": 1e-4}).draw(np.random.default_rng(0))
    model = Model(cartpole.task, policy, cartpole.nominal, cartpole.bias.fit(cartpole.no_data))
    compiled, plain = join([simulator(model, noise)]), PlainSimulator([model], [noise])
    scenarios = np.zeros(len(thetas), np.int64)
    with interpreted():
        written = compiled.rollouts(thetas, starts, scenarios)
    ends = set()
    for one, other in zip(written, plain.rollouts(thetas, starts), strict=True):
        assert one.frames == other.frames
        ends.add(one.frames)
        np.testing.assert_allclose(one.inputs, other.inputs, rtol=1e-6, atol=1e-6)
    assert len(ends) > 3
    assert 100 in ends


@pytest.mark.slow
def test_exported_it_is_what_it_is_in_numpy(cartpole: Study) -> None:
    """In C and Python, over more frames than its table has; files are only made if they agree.

    It has all that it can have: a filter of a late motor and of disturbances, and gains for friction.
    """
    _, (theta,) = around(cartpole, 1)
    rig = Rig(cartpole.task, cartpole.nominal, {"force": Motor(delay=0.05)}, {})
    nominal = with_values(rig, **{"force.delay": 1.5 * cartpole.task.time_step})
    policy = Trajectory(cartpole.task, cartpole.nominal, KNOTS, observer="disturbance", sliding=True)
    rows = theta.reshape(KNOTS, 9)
    theta = np.concatenate([rows, 0.1 * rows[:, 5:]], axis=1).ravel()
    request = ExperimentRequest(cartpole.task, policy.designed_on(nominal), theta, cartpole.task.start_mean)
    assert request.why_no_code == ""
    made = files(request)
    assert "static const double v" in made[HEADER]
    assert "np.interp(t / " in made[MODULE]
