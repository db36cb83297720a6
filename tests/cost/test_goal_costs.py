"""Costs of a goal that moves: their formulas, and compiled sums that are those of the records."""

import numpy as np
import pytest
from interpreted import interpreted
from mechanisms import declared

import simbias
from simbias.core import Cost, Model, Task
from simbias.core.records import Array, Rollout
from simbias.cost.declared import Declared
from simbias.cost.saturating import Saturating
from simbias.cost.tracking import Tracking
from simbias.simulation.compiled import CompiledSimulator
from simbias.simulation.compiler.closed_loop import REDUCTIONS

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


def test_they_are_their_formulas_and_summed_up_frame_by_frame() -> None:
    task, study = declared(goal=GOAL, failure=None, horizon=25), simbias.load(["preset=cartpole"])
    model = Model(task, study.policy, study.nominal, study.bias.fit(study.no_data))
    starts = np.array([[0.0, 0.1, 0.0, 0.0], [0.1, 0.0, 0.1, 0.0]])
    thetas = np.full((2, 4), 0.5)
    for index, cost in enumerate(costs(task)):
        simulator = CompiledSimulator.of(model, None, cost)
        assert simulator is not None
        assert simulator.sums_up(cost)
        with interpreted():
            found, _ = simulator.costs(cost, thetas, starts)
            rollouts = simulator.rollouts(thetas, starts)
        of_records = [cost.of(rollout) for rollout in rollouts]
        formulas = [expected(rollout.states, rollout.inputs, task)[index] for rollout in rollouts]
        np.testing.assert_allclose(of_records, formulas, rtol=1e-12)
        np.testing.assert_allclose(found, of_records, rtol=1e-9)


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
        ({}, "one has to be more than 0"),
        ({task.goals[0].name: 1e-300}, "those above 0 have to be 1e-09 at least"),
    ):
        with pytest.raises(ValueError, match=f"widths: {words}"):
            Saturating(task, widths, 0.5)
    with pytest.raises(ValueError, match="running: 'power'"):
        Declared(task, 1.0, 1.0, running="power")


def test_what_is_no_number_costs_a_finite_number() -> None:
    """As of a model that explodes within a frame; totals leave it out."""
    task = declared(goal=GOAL)
    for far in (1e160, np.inf, np.nan):
        rollout = Rollout(np.array([task.start_mean, np.full(4, far)]), np.zeros((1, 1)), 1, "state")
        assert all(np.isfinite(cost.of(rollout)) for cost in costs(task)), far
    for reduction in REDUCTIONS.values():
        assert eval(reduction.format("total", "term"), {"total": 2.5, "term": np.nan}) == 2.5
