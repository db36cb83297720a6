"""The compiled closed loop against the plain one, and the rules that both keep."""

import os
import signal
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from in_numpy import OfAllLanes, by_value
from interpreted import assert_alike, interpreted
from numba import get_num_threads, set_num_threads
from point_mass import Spring

import simbias
from simbias.core import NOT_A_NUMBER, FittedBias, Nominal, Policy, StudyWarning
from simbias.core.records import Array, Disturbance, Transitions
from simbias.lab.safety import Safety, SafetyLimitedPolicy
from simbias.learning.bias.none import ZeroBias
from simbias.simulation.closed_loop import SimulatorSequence, join, simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.study import Study

STATE_SCALE = np.array([0.3, 0.1, 0.3, 1.0, 1.0, 1.0])
STABLE = np.array([8.12, 4.73, -6.74, -1.02, -5.56])  # balances the nominal model: DIRECT's optimum


def both(
    study: Study, bias: FittedBias, disturbance: Disturbance | None = None, frames: int = 5000
) -> tuple[CompiledSimulator, PlainSimulator]:
    model = replace(study.model(bias), task=study.task.with_horizon(min(frames, study.task.horizon)))
    compiled = simulator(model, disturbance, study.cost)
    assert isinstance(compiled, CompiledSimulator)
    return compiled, PlainSimulator([model], [disturbance])


def learned(study: Study, n: int = 60) -> FittedBias:
    """A bias from made-up, smooth residuals of some 0.1 mrad, as the hardware's are."""
    rng = np.random.default_rng(1)
    scale = np.append(STATE_SCALE, 20.0)
    inputs = rng.normal(size=(n, 7))
    return study.bias.fit(Transitions(inputs * scale, 1e-4 * np.tanh(inputs @ rng.normal(size=(7, 6)))))


def noise(rng: np.random.Generator, frames: int, of_inputs: float, of_sensors: float) -> Disturbance:
    inputs = of_inputs * rng.normal(size=(frames, 1))
    return Disturbance(inputs, of_sensors * rng.normal(size=(frames + 1, 6)))


def drawn(study: Study, rng: np.random.Generator, count: int, most: float = 10.0) -> tuple[Array, Array]:
    """Policies (count, p) and starts (count, n)."""
    starts = np.array([study.task.draw_start(rng) for _ in range(count)])
    return rng.uniform(-most, most, (count, 5)), starts


@pytest.fixture(scope="module")
def one_step() -> Study:
    """A study whose rollouts end after one step."""
    return simbias.load(["tracking=none", "task.horizon=1"])


@pytest.mark.slow
def test_single_steps_agree(one_step: Study) -> None:
    """One step from random states: single precision leaves 1e-9 of a correction of some 1e-4."""
    rng = np.random.default_rng(0)
    thetas, starts = rng.uniform(-5, 5, (100, 5)), rng.normal(size=(100, 6)) * STATE_SCALE
    noisy = [(ZeroBias(6), 1e-13, noise(rng, 1, 1.0, 0.01)) for _ in range(3)]
    for bias, tolerance, disturbance in ((ZeroBias(6), 1e-13, None), *noisy, (learned(one_step), 1e-9, None)):
        fast, slow = (loop.rollouts(thetas, starts) for loop in both(one_step, bias, disturbance))
        assert_alike(fast, slow, 1e-11, tolerance, of_inputs=1e-12)


def test_noise_and_a_bias_of_all_lanes_are_written_as_the_plain_loop_has_them(study: Study) -> None:
    """In two scenarios, with records and with sums of the cost."""
    rng, task = np.random.default_rng(0), study.task.with_horizon(40)
    noises = [noise(rng, 40, 1.0, 1e-3) for _ in range(2)]
    model = replace(study.model(OfAllLanes(6)), task=task)
    asked = (*drawn(study, rng, 20, 5.0), rng.integers(0, 2, 20))
    with interpreted():
        loop = join([simulator(model, each, study.cost) for each in noises])
        assert isinstance(loop, CompiledSimulator)
        rollouts, (costs, _) = loop.rollouts(*asked), loop.costs(study.cost, *asked)
    plain = PlainSimulator([model, model], noises).rollouts(*asked)
    assert_alike(rollouts, plain, 1e-9, 1e-12)
    np.testing.assert_allclose(costs, [study.cost.of(each) for each in plain], rtol=1e-9)


@pytest.mark.slow
def test_stable_rollouts_agree(study: Study) -> None:
    """A stable loop contracts the differences of single steps, so its whole cost agrees."""
    for bias, tolerance in ((ZeroBias(6), 1e-9), (learned(study), 1e-5)):
        fast, slow = (s.rollout(STABLE, study.task.start_mean) for s in both(study, bias, frames=500))
        assert fast.failed_at is None
        assert study.cost.of(fast) == pytest.approx(study.cost.of(slow), rel=tolerance)


def test_falls_agree_and_bad_starts_fail_at_once(study: Study) -> None:
    """What is not finite fails; where nothing is to run, as screening leaves it, there is no rollout."""
    loops = both(study, ZeroBias(6))
    fast, slow = (loop.rollout(np.zeros(5), study.task.start_mean) for loop in loops)
    assert fast.failed_at == slow.failed_at == len(fast.inputs) == len(fast.states) - 1
    assert fast.failure == slow.failure
    assert fast.failure in {criterion.name for criterion in study.task.criteria}
    for loop in loops:
        rollout = loop.rollout(np.zeros(5), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 100.0]))
        assert (rollout.failed_at, rollout.failure, rollout.frames) == (0, "speed", 0)
        assert loop.rollout(np.zeros(5), np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0])).failed_at == 0
        assert loop.rollouts(np.empty((0, 5)), np.empty((0, 6))) == []
        costs, frames = loop.costs(study.cost, np.empty((0, 5)), np.empty((0, 6)))
        assert costs.shape == frames.shape == (0,)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_state_that_is_not_finite_fails_though_no_criterion_reads_it() -> None:
    """The pole's rate, without a warning; a criterion that is violated besides goes before."""
    study = simbias.load(["preset=cartpole", "bias=none", "tracking=none"])
    thetas, starts = np.full((3, 4), 10.0), np.zeros((3, 4))
    starts[:, 1], starts[:, 3] = [0.1, 0.3, 0.1], [np.inf, np.inf, 1e308]
    plain = PlainSimulator([study.model()], [None]).rollouts(thetas, starts)
    with interpreted():
        for made in (plain, study.simulator().rollouts(thetas, starts)):
            failures = [(each.failed_at, each.failure) for each in made]
            assert failures == [(0, NOT_A_NUMBER), (0, "falls"), (1, "falls")]


def test_noise_acts_where_it_belongs(one_step: Study) -> None:
    """On the sensors it changes the command; on the input what the model does, and not the command."""
    theta, start = np.array([1.0, 1.0, 1.0, 1.0, 1.0]), one_step.task.start_mean
    none, one = np.zeros((2, 6)), np.full((2, 6), 0.1)
    quiet = one_step.simulator().rollout(theta, start)
    seen_input = one_step.policy.controller(theta, 0.001)(start + 0.1)
    for loop in both(one_step, ZeroBias(6), Disturbance(np.zeros((1, 1)), one)):
        seen = loop.rollout(theta, start)
        np.testing.assert_allclose(seen.inputs[0], seen_input, rtol=1e-9)
        np.testing.assert_array_equal(seen.states[0], start)
    for loop in both(one_step, ZeroBias(6), Disturbance(np.full((1, 1), 5.0), none)):
        pushed = loop.rollout(theta, start)
        np.testing.assert_allclose(pushed.inputs, quiet.inputs, rtol=1e-9)
        np.testing.assert_allclose(pushed.states[1], one_step.nominal.step(start, quiet.inputs[0] + 5.0))


def test_components_in_numpy_work_and_mix_with_compiled_ones(point_mass: Study) -> None:
    """A user's components have no kernels; the GP, which has one, runs beside them."""
    rollout = point_mass.simulate(np.array([9.0, 4.0, 0.0]))
    assert rollout.frames == point_mass.task.horizon
    assert rollout.cost == point_mass.cost.of(rollout) < 0.1875
    plain = PlainSimulator([point_mass.model()], [None]).rollout(np.array([9.0, 4.0, 0.0]), rollout.states[0])
    np.testing.assert_allclose(plain.states, rollout.states, rtol=1e-9, atol=1e-12)


class InNumPy(Nominal):
    """The bongoboard's model in a way that only NumPy can run."""

    def __init__(self, study: Study) -> None:
        self._model = study.nominal

    @by_value
    def step(self, x: Array, u: Array) -> Array:
        return self._model.step(x, u)


@pytest.mark.slow
def test_a_plain_model_has_a_compiled_bias_beside_it(study: Study) -> None:
    """In one scenario or in several, alone or among others: single precision is all that differs."""
    rng, bias = np.random.default_rng(0), learned(study)
    model = replace(study.model(bias), task=study.task.with_horizon(100), nominal=InNumPy(study))
    models = [replace(model, bias=each) for each in (bias, bias.draw(rng), bias.draw(rng))]
    _, starts = drawn(study, rng, 20)
    thetas, scenarios = STABLE + 0.1 * rng.normal(size=(20, 5)), rng.integers(0, 3, 20)
    with pytest.warns(StudyWarning):
        loops = join([simulator(each) for each in models]), PlainSimulator(models, [None] * 3)
    quick, plain = (loop.rollouts(thetas, starts, scenarios) for loop in loops)
    assert_alike(quick, plain, 1e-4, 1e-6, of_inputs=1e-4)
    alone = simulator(models[scenarios[7]]).rollout(thetas[7], starts[7])
    np.testing.assert_array_equal(alone.states, quick[7].states)
    unbiased = PlainSimulator([replace(model, bias=ZeroBias(6))], [None]).rollout(thetas[7], starts[7])
    assert np.abs(unbiased.states - alone.states).max() > 1e-4


def test_rollouts_depend_neither_on_those_beside_them_nor_on_threads(study: Study) -> None:
    """To the last bit; most fall, and others take their places."""
    thetas, starts = drawn(study, np.random.default_rng(0), 40)
    loop = study.simulator(learned(study))
    together = loop.rollouts(thetas, starts)
    assert len({rollout.frames for rollout in together}) > 20
    for rollout, theta, start in zip(together, thetas, starts, strict=True):
        np.testing.assert_array_equal(rollout.states, loop.rollout(theta, start).states)
    before, numbers = get_num_threads(), []
    try:
        for threads in (1, 2):
            set_num_threads(min(threads, before))
            numbers.append(loop.costs(study.cost, thetas, starts)[0])
    finally:
        set_num_threads(before)
    np.testing.assert_array_equal(*numbers)


def test_worlds_in_step_are_worlds_apart(study: Study) -> None:
    """To the last bit, whatever differs: noise, the nominal model's parameters, a bias that was drawn."""
    rng = np.random.default_rng(0)
    bias, without = learned(study), study.model(ZeroBias(6))
    models = [replace(without, nominal=study.nominal.draw(rng)) for _ in range(3)]
    noisy = [simulator(each, noise(rng, study.task.horizon, 0.3, 0.01), study.cost) for each in models]
    own = [simulator(replace(each, bias=bias.draw(rng)), cost=study.cost) for each in models]
    asked = (*drawn(study, rng, 20), rng.integers(0, 3, 20))
    for several, in_lockstep in ((noisy, True), (own, False), ([*noisy[:2], own[0]], False)):
        made = join(several)
        assert isinstance(made, CompiledSimulator if in_lockstep else SimulatorSequence)
        for cost, frames, theta, start, scenario in zip(*made.costs(study.cost, *asked), *asked, strict=True):
            assert several[scenario].costs(study.cost, theta[None], start[None]) == (cost, frames)


def test_starts_of_another_shape_are_refused(study: Study) -> None:
    """Compiled loops would read foreign memory, and plain ones take one number for all states."""
    thetas, starts = drawn(study, np.random.default_rng(0), 3)
    for loop in both(study, ZeroBias(6)):
        for others in (starts[:, :5], starts[:, :1], starts[:1]):
            with pytest.raises(ValueError, match=r"^starts: expected the shape \(3, 6\), got \("):
                loop.costs(study.cost, thetas, others)


@pytest.mark.slow
def test_costs_are_those_of_the_rollouts(study: Study) -> None:
    """Summed up frame by frame in the one, read from the record in the other; to failure or horizon."""
    rng = np.random.default_rng(0)
    thetas, starts = drawn(study, rng, 40)
    noisy = noise(rng, 5000, 0.3, 1e-3)
    for bias, disturbance in ((ZeroBias(6), None), (ZeroBias(6), noisy), (learned(study), None)):
        loop, _ = both(study, bias, disturbance)
        rollouts = loop.rollouts(thetas, starts)
        costs, frames = loop.costs(study.cost, thetas, starts)
        np.testing.assert_allclose(costs, [study.cost.of(rollout) for rollout in rollouts], rtol=1e-12)
        np.testing.assert_array_equal(frames, [rollout.frames for rollout in rollouts])


@pytest.mark.skipif(sys.platform == "win32", reason="a signal there does not wake who waits for a thread")
def test_an_interrupt_ends_compiled_rollouts(study: Study) -> None:
    """Ctrl-C, in the middle of rollouts that would take a minute; the same ones can be made afterwards."""
    model = replace(study.model(ZeroBias(6)), task=study.task.with_horizon(100_000_000))
    loop, k = simulator(model), 20
    thetas, starts = np.zeros((k, 5)), np.tile(study.task.start_mean, (k, 1))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
    loop.costs(study.cost, thetas, starts)  # compiled, and they all fall
    sent: list[float] = []

    def interrupt() -> None:
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)  # as a terminal: to the process, not to this thread

    timer = threading.Timer(0.1, interrupt)
    try:
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            loop.costs(study.cost, thetas, np.zeros((k, 6)))  # upright, at rest
        assert time.monotonic() - sent[0] < 2
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)
    assert (loop.costs(study.cost, thetas, starts)[1] > 0).all()


@pytest.mark.slow
def test_plain_rollouts_do_not_depend_on_those_beside_them(study: Study) -> None:
    """To the last bit, in one scenario and in several, with a bias that needs linear algebra."""
    rng = np.random.default_rng(0)
    model = replace(study.model(learned(study)), task=study.task.with_horizon(50))
    noisy = noise(rng, 50, 0.3, 0.01)
    loops = [PlainSimulator([replace(model, nominal=study.nominal.draw(rng))], [noisy]) for _ in range(2)]
    asked = (*drawn(study, rng, 9), rng.integers(0, 2, 9))
    with pytest.warns(StudyWarning):
        together = join(loops).rollouts(*asked)
    for rollout, theta, start, scenario in zip(together, *asked, strict=True):
        alone = loops[scenario].rollout(theta, start)
        np.testing.assert_array_equal(rollout.states, alone.states)
        np.testing.assert_array_equal(rollout.inputs, alone.inputs)


class Filtered(Policy):
    """Integral action on a low-pass filter of the first output, from a tenth of a second on."""

    state_size = 2

    def __init__(self, study: Study) -> None:
        self.n_parameters, self.bounds = 5, study.policy.bounds
        self._task, self._linear, self._dt = study.task, study.policy, study.task.time_step

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        z = self._task.output(x)
        smooth = policy_state[..., 0] + 0.1 * (z[..., 0] - policy_state[..., 0])
        total = policy_state[..., 1] + self._dt * smooth * (t >= 0.1)
        u = (self._linear.gains(theta) @ z[..., None])[..., 0] + 5 * (smooth + total)[..., None]
        limit = self._task.input_limit
        return np.clip(u, -limit, limit), np.stack([smooth, total], axis=-1)


def test_a_policy_with_a_state_and_time(study: Study) -> None:
    """In lanes, in NumPy, and in a control loop written by hand: as on a robot."""
    policy, task = Filtered(study), study.task.with_horizon(150)
    model = replace(study.model(ZeroBias(6)), policy=policy, task=task)
    thetas, starts = np.array([STABLE, -STABLE, STABLE]), np.tile(task.start_mean, (3, 1))
    controller, x, states = policy.controller(STABLE, task.time_step), task.start_mean, [task.start_mean]
    for _ in range(150):
        x = study.nominal.step(x, controller(x))
        states.append(x)
    assert isinstance(simulator(model), CompiledSimulator)
    for loop in (simulator(model), PlainSimulator([model], [None])):
        with interpreted():
            first, fall, third = loop.rollouts(thetas, starts)
        np.testing.assert_allclose(first.states, states, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(first.states, third.states)
        assert fall.failure is not None


class Wraps(Spring):
    """Writes into what it is given."""

    def act(self, theta: Array, x: Array, t: float, policy_state: Array) -> tuple[Array, Array]:
        x[..., :1] = np.minimum(x[..., :1], 0.3)
        return super().act(theta, x, t, policy_state)


def test_what_a_policy_writes_into_is_its_own(point_mass: Study) -> None:
    """Neither records nor the robot's state; a robot may also give it a list."""
    policy, theta, task = Wraps(point_mass.task), np.array([9.0, 4.0, 0.0]), point_mass.task
    model = replace(point_mass.model(), policy=policy)
    states = PlainSimulator([model], [None]).rollout(theta, task.start_mean).states
    controller, x = policy.controller(theta, task.time_step), task.start_mean
    limits = Safety(states={"velocity": 99.0}).bounds(task)
    limited = SafetyLimitedPolicy(policy, task, limits).controller(theta, task.time_step)
    for x_next in states[1:]:
        u = controller(x)
        np.testing.assert_array_equal(limited(x.tolist()), u)
        x = point_mass.nominal.step(x, u)
        np.testing.assert_array_equal(x, x_next)
    assert task.start_mean[0] == states[0, 0] == 0.5
