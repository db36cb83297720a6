"""Swing-ups that no linear policy can do: found on the model, and judged by the task."""

import numpy as np
import pytest

import simbias
from simbias.core.records import Disturbance
from simbias.simulation.closed_loop import simulator
from simbias.simulation.numpy_loop import PlainSimulator
from simbias.trial.diagnostics import of_goal

pytestmark = pytest.mark.slow


def test_a_trial_swings_up_a_cart_pole_with_friction_and_a_weak_motor() -> None:
    """Shortened: one experiment an iteration, and fewer simulated policies. They are as in NumPy."""
    options = ["optimizer.max_evaluations=6000", "evaluation.rollouts=4", "budget.experiments=4"]
    study = simbias.load(["preset=cartpole_swingup", "tracking=none", "method.experiments=1", *options])
    last = list(study.run())[-1]
    assert last.succeeded
    assert last.search.predicted_cost < 0.5  # 1 is the cost of hanging
    (rollout,) = last.experiments
    held = np.abs(study.task.error(rollout.states, 0.0)[-51:, 1])  # of the angle in the last second
    assert rollout.states[0, 1] == pytest.approx(np.pi, abs=0.3)
    assert held.max() < 0.2
    start = study.task.start_mean
    T = study.task.horizon
    assert study.task.succeeds(np.tile(start, (T + 1, 1))) is False
    calm = Disturbance(np.zeros((T, 1)), np.zeros((T + 1, 4)))  # with noise, it is the loop of the search
    compiled = simulator(last.model, calm, study.cost).rollout(last.parameters, start)
    (plain,) = PlainSimulator([last.model], [None]).rollouts(last.parameters[None], start[None])
    np.testing.assert_allclose(compiled.states, plain.states, atol=1e-6)


@pytest.mark.usefixtures("uncompiled")
def test_a_policy_that_does_not_swing_up_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    study = simbias.load(["preset=cartpole_swingup", "tracking=none"])
    (remark,) = of_goal(np.zeros(study.policy.n_parameters), study.first_model(), study.cost)
    assert "off by position 0 m, angle 3.14 rad, its inputs at their limits in 0% of" in remark.words
    assert "does not reach the goal in 5 s" in remark.words
    balancing = simbias.load(["preset=cartpole", "tracking=none"])  # its cost says what success is
    assert not list(of_goal(np.zeros(balancing.policy.n_parameters), balancing.first_model(), balancing.cost))
    unlimited = property(lambda task: (-task.input_limit, np.full(1, np.inf)))
    monkeypatch.setattr(type(study.task), "input_bounds", unlimited)
    (remark,) = of_goal(np.zeros(study.policy.n_parameters), study.first_model(), study.cost)
    assert "its inputs at their limits in 0% of" in remark.words


def test_late_motors_are_met_before_any_experiment() -> None:
    study = simbias.load(["preset=cartpole_swingup", "tracking=none"])
    names = [parameter.name for parameter in study.first_model().nominal.parameters]
    assert names[-2:] == ["force.gain", "force.delay"]
    without = simbias.load(["preset=cartpole_swingup", "tracking=none", "identification=none"])
    assert without.first_model().nominal is without.nominal
