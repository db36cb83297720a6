"""Costs: their formulas, of goals that move too, and compiled sums that are those of the records."""

import warnings
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_numpy import OfAllLanes
from interpreted import interpreted
from mechanisms import declared

import simbias
from simbias.core import Cost, FittedBias, Model, StudyWarning, Task
from simbias.core.records import Array, Indices, Rollout
from simbias.cost.declared import Declared
from simbias.cost.quadratic import Quadratic
from simbias.cost.saturating import Saturating
from simbias.cost.tracking import Tracking
from simbias.learning.bias.none import ZeroBias
from simbias.simulation.closed_loop import simulator
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler import of_cost
from simbias.simulation.compiler.closed_loop import REDUCTIONS
from simbias.trial.study import Study

R = np.diag([10, 10, 10, 0.1, 0.1, 0.1])  # Table I
Q = np.diag([1e-6])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.booleans())
def test_cost_is_equation_8(study: Study, seed: int, frames: int, fails: bool) -> None:
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(frames + 1, 6)), 30 * rng.normal(size=(frames, 1))
    T, t_fail = 5000, frames if fails else 5000
    peak = max(x[t] @ R @ x[t] for t in range(1, frames + 1))
    effort = sum(u[t] @ Q @ u[t] for t in range(frames))
    rollout = Rollout(x, u, failed_at=frames if fails else None, failure="a fall" if fails else None)
    assert study.cost.of(rollout) == pytest.approx(200 * (T - t_fail) + peak + effort, rel=1e-12)


class Moving(Cost):
    """Distance of the first state from a moving reference, and the inputs' latest change of sign."""

    reductions = ("sum", "max")
    max_cost = 10.0

    def __init__(self, task: Task) -> None:
        self.horizon, self.time_step = task.horizon, task.time_step

    def terms(self, x_next: Array, u: Array, t: Any) -> Array:
        return np.stack([(x_next[..., 0] - np.sin(3 * t)) ** 2, np.where(u[..., 0] > 0, t, 0.0)], axis=-1)

    def of_totals(self, totals: Array, lost: Indices) -> Array:
        return totals.sum(axis=-1) + lost


class OfAll(Moving):
    """The same, which says nothing of single frames."""

    reductions = ()

    def of(self, rollout: Rollout) -> float:
        x, u = rollout.states[1:, 0], rollout.inputs[:, 0]
        t = self.time_step * np.arange(1, len(x) + 1)
        lost = 0 if rollout.failed_at is None else self.horizon - rollout.failed_at
        return float(np.sum((x - np.sin(3 * t)) ** 2) + np.max(t * (u > 0), initial=0.0) + lost)


class Raised(Moving):
    """A thousand more than its terms say."""

    def of(self, rollout: Rollout) -> float:
        return super().of(rollout) + 1000.0


@pytest.mark.slow
@pytest.mark.parametrize("bias", [ZeroBias, OfAllLanes])
def test_a_cost_knows_the_time_summed_up_and_of_a_record(study: Study, bias: type[FittedBias]) -> None:
    """Where a bias corrects all lanes at once, too."""
    rng, lower = np.random.default_rng(0), study.policy.bounds[0]
    thetas = rng.uniform(lower, -lower, (20, len(lower)))
    starts = np.array([study.task.draw_start(rng) for _ in thetas])
    model = replace(study.model(bias(6)), task=study.task.with_horizon(150))
    with interpreted():
        loop = simulator(model)
        assert isinstance(loop, CompiledSimulator)
        fast, frames = loop.costs(Moving(model.task), thetas, starts)
        slow, _ = loop.costs(OfAll(model.task), thetas, starts)
        raised, _ = loop.costs(Raised(model.task), thetas, starts)
        records = [Moving(model.task).of(rollout) for rollout in loop.rollouts(thetas, starts)]
    assert len(set(frames.tolist())) > 5
    np.testing.assert_allclose(fast, slow, rtol=1e-9)
    np.testing.assert_allclose(fast, records, rtol=1e-9)
    np.testing.assert_allclose(raised, fast + 1000.0, rtol=1e-9)


def test_what_succeeds(study: Study) -> None:
    """Who falls in the very last frame does not, nor who costs just Z_max (line 10)."""
    states, inputs = np.zeros((5001, 6)), np.zeros((5000, 1))
    states[0] = 100.0  # the maximum of Eq. 8 is over t = 1..T
    fallen, balanced = Rollout(states, inputs, failed_at=5000, failure="a fall"), Rollout(states, inputs)
    assert study.cost.of(fallen) == study.cost.of(balanced) == 0.0  # no penalty is left for t_fail = T
    for rollout, cost, passes in (
        (fallen, 0.0, False),
        (balanced, 0.0, True),
        (balanced, np.nextafter(200.0, 0.0), True),
        (balanced, 200.0, False),
    ):
        assert study.cost.passes(replace(rollout, cost=cost)) == passes
    before = Rollout(states[:-1], inputs[:-1], failed_at=4999, failure="a fall")
    assert study.cost.of(before) == 200 >= study.cost.max_cost  # every other failure costs more


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5))
def test_over_a_longer_horizon_an_effort_that_lasts_costs_the_same(
    study: Study, seed: int, times: int
) -> None:
    """And a failure costs as much as before for each frame that it loses."""
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(101, 6)), 30 * rng.normal(size=(100, 1))
    once = Rollout(x, u)
    again = Rollout(np.concatenate([x, np.tile(x[1:], (times - 1, 1))]), np.tile(u, (times, 1)))
    longer = study.cost.with_horizon(times * study.task.horizon)
    assert longer.of(again) == pytest.approx(study.cost.of(once), rel=1e-12)
    fallen = replace(once, failed_at=100, failure="a fall")
    lost = (times - 1) * study.task.horizon
    assert longer.of(fallen) - longer.of(once) == pytest.approx(
        study.cost.of(fallen) - study.cost.of(once) + 200 * lost
    )


def test_weights_by_name_are_weights_by_place(study: Study) -> None:
    """An own name goes before a kind, and what is not named weighs nothing."""
    by_name = {"angle": 10.0, "velocity": 0.1, "d_theta": 0.5}
    named = Quadratic(study.task, 200.0, by_name, {"torque": 1e-6}, 200.0)
    placed = Quadratic(study.task, 200.0, [10, 10, 10, 0.1, 0.1, 0.5], [1e-6], 200.0)
    rng = np.random.default_rng(0)
    rollout = Rollout(rng.normal(size=(11, 6)), rng.normal(size=(10, 1)))
    assert named.of(rollout) == placed.of(rollout)
    for weights, words in (({"size": 1.0}, "nothing is called size"), ([10.0, 1.0], "has 2 values")):
        with pytest.raises(ValueError, match=f"state_weights:? {words}"):
            Quadratic(study.task, 200.0, weights, [1e-6], 200.0)


GOAL = {"position": "0.3 * sin(2 * t)", "angle": 0.05}


def costs(task: Task) -> list[Cost]:
    return [
        Saturating(task, {"position": 0.2}, 0.5, {"force": 1e-4}),
        Tracking(task, {"position": 2.0, "angle": 1.0}, 9.0, 10.0, {"force": 1e-4}, {"angle": 3.0}),
        Declared(task, 9.0, 10.0, "2 * position_error**2 + c * force**2", "abs(angle)", "t * angle_error**2",
                 {"c": 1e-4}),
    ]  # fmt: skip


def expected(x: Array, u: Array, task: Task) -> list[float]:
    """The costs of a whole rollout of states (T+1, n) and inputs (T, m), written out."""
    t = task.time_step * np.arange(1, len(x))
    e, a, effort = x[1:, 0] - 0.3 * np.sin(2 * t), x[1:, 1] - 0.05, 1e-4 * u[:, 0] ** 2
    return [
        float(np.mean(1 - np.exp(-0.5 * (e / 0.2) ** 2) + effort)),
        float(np.mean(2 * e**2 + a**2 + effort) + 3 * a[-1] ** 2),
        float(np.mean(2 * e**2 + effort) + np.max(np.abs(x[1:, 1])) + t[-1] * a[-1] ** 2),
    ]


@pytest.mark.slow
def test_they_are_their_formulas_and_summed_up_frame_by_frame() -> None:
    task, study = declared(goal=GOAL, failure=None, horizon=25), simbias.load(["preset=cartpole"])
    model = Model(task, study.policy, study.nominal, study.bias.fit(study.no_data))
    starts = np.array([[0.0, 0.1, 0.0, 0.0], [0.1, 0.0, 0.1, 0.0]])
    thetas = np.full((2, 4), 0.5)
    for index, cost in enumerate(costs(task)):
        simulator = CompiledSimulator.of(model, None, cost)
        assert simulator is not None
        assert of_cost(cost, task).kernel is not None
        with interpreted():
            found, _ = simulator.costs(cost, thetas, starts)
            rollouts = simulator.rollouts(thetas, starts)
        of_records = [cost.of(rollout) for rollout in rollouts]
        formulas = [expected(rollout.states, rollout.inputs, task)[index] for rollout in rollouts]
        np.testing.assert_allclose(of_records, formulas, rtol=1e-12)
        np.testing.assert_allclose(found, of_records, rtol=1e-9)
    for running in ("sqrt(position - 5)", "-1 / max(position - 5, 0)"):  # nan, infinite
        wrong = Declared(task, 9.0, 10.0, running=running)
        with interpreted():
            assert (CompiledSimulator.of(model, None, wrong).costs(wrong, thetas, starts)[0] > 1e90).all()
        assert min(wrong.of(rollout) for rollout in rollouts) > 1e90


def test_a_failure_costs_what_it_takes_away() -> None:
    task = declared(goal=GOAL)
    x, u = np.zeros((26, 4)), np.zeros((25, 1))
    for cost, weight in zip(costs(task), (1.0, 10.0, 10.0), strict=True):
        failed = Rollout(x, u, 25, "falls")
        t = task.time_step * np.arange(1, 26)
        summed, peak, last = cost.terms(x[1:], u, t).sum(axis=0).tolist(), 0.0, 0.0
        assert cost.of(failed) == pytest.approx((weight * 100 + summed[0]) / 125 + peak + last)
        assert cost.of(Rollout(x[:2], u[:1], 1, "falls")) > 0.9 * weight
        longer = cost.with_horizon(250)
        assert longer.of(failed) == pytest.approx((weight * 225 + summed[0]) / 250)


def test_what_it_does_not_know_is_refused() -> None:
    task = declared(goal=GOAL)
    for widths, words in (
        ({"torque": 1.0}, "nothing is called torque"),
        ({}, "at least one must be above 0"),
        ({task.goals[0].name: 1e-300}, "those above 0 must be at least 1e-09"),
    ):
        with pytest.raises(ValueError, match=f"widths: {words}"):
            Saturating(task, widths, 0.5)
    with pytest.raises(ValueError, match=r"^cost\.widths\.angle: must be greater than or equal to 0"):
        simbias.load(["preset=pendulum_swingup", "tracking=none", "cost.widths.angle=-1"])
    drawn = {"goal": {"angle": "place"}, "targets": {"place": {"unit": "rad", "deviation": 0.1}}}
    for changes in {"goal": {"angle": "0.01 * t"}}, drawn:
        with pytest.raises(ValueError, match=r"state_weights: angle would be weighted .*; cost=tracking wei"):
            Quadratic(declared(**changes), 1.0, {"angle": 1.0}, {}, 1.0)
    Quadratic(declared(goal={"angle": "0.01 * t"}), 1.0, {"position": 1.0}, {}, 1.0)
    Quadratic(declared(goal={"angle": "sin(pi)"}), 1.0, {"angle": 1.0}, {}, 1.0)  # zero but for rounding
    with pytest.raises(ValueError, match="running: 'power'"):
        Declared(task, 1.0, 1.0, running="power")
    with pytest.raises(ValueError, match="running is not finite in any of 100 states"):
        Declared(task, 1.0, 1.0, running="sqrt(-1 - angle**2)")
    with pytest.warns(StudyWarning, match="the cost is constant: policies differ only by when they fail"):
        Declared(task, 1.0, 1.0, running="1")
    propellers = {f"µ{index}": {"unit": "N", "limit": 6.0, "lower": 5.0} for index in range(8)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        roots = " + ".join(f"sqrt({name} - 5)" for name in propellers)
        Declared(declared(inputs=propellers), 1.0, 1.0, running=roots)


def test_what_is_not_finite_costs_a_finite_number(study: Study) -> None:
    """As of a model that explodes within a frame; totals leave it out."""
    moving = declared(goal=GOAL)
    pairs = ((study.task, [study.cost]), (moving, costs(moving)))
    for far, (task, made) in product((1e160, np.inf, np.nan), pairs):
        x = np.array([task.start_mean, np.full(len(task.states), far)])
        found = [cost.of(Rollout(x, np.zeros((1, 1)), failed_at=1, failure="distance")) for cost in made]
        assert np.isfinite(found).all(), far
        assert task is moving or study.cost.max_cost < found[0]
    rooted, x = Declared(moving, 9.0, 10.0, peak="sqrt(angle)"), np.zeros((4, 4))
    assert rooted.oddity(Rollout(x, np.zeros((3, 1)))) is None
    x[2, 1] = -0.1
    oddity = rooted.oddity(Rollout(x, np.zeros((3, 1))))
    assert oddity is not None
    assert oddity[1].startswith("cost.peak is not finite at t = 0.08 s")
    for reduction in REDUCTIONS.values():
        assert eval(reduction.format("total", "term"), {"total": 2.5, "term": np.nan}) == 2.5
