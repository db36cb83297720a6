"""What is found before a trial begins: robots at rest, boxes without zero, costs of one horizon only."""

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from pendulum import pendulum

import simbias
from simbias.core import Cost, Evaluation, Model, Policy
from simbias.core.records import Array, Rollout
from simbias.testing.conformance import verdicts
from simbias.testing.expectations import rollout
from simbias.trial.study import Study
from simbias.trial.warm_up import warm_up

FEW = ["identification.starts=2", "identification.rounds=1", "identification.evaluations=2"]


class Noting(Evaluation):
    """Notes the policies that it evaluates."""

    def __init__(self) -> None:
        self.thetas: list[Array] = []

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Any:
        return self.thetas.append


class Constant(Cost):
    max_cost = 1.0

    def of(self, rollout: Rollout) -> float:
        return 2.0


def problems(study: Study, group: str) -> list[str]:
    return [verdict.problem for verdict in verdicts(study, {group}) if verdict.problem]


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "plain_predictions")
def test_what_rests_without_inputs_is_warmed_up() -> None:
    """A hanging pendulum: nothing errs, so there is nothing to whiten by."""
    study = pendulum("identification=posterior", "bias=window_gp", "task.horizon=120", *FEW)
    assert not study.simulate(np.zeros(study.policy.n_parameters)).states.any()
    warm_up(study)
    assert problems(study, "identification") == []


@pytest.mark.usefixtures("uncompiled")
def test_the_warm_up_keeps_to_the_policys_box() -> None:
    study = simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF)
    policy, evaluation = copy(study.policy), Noting()
    policy.bounds = (np.full(policy.n_parameters, 0.5), policy.bounds[1])
    warm_up(replace(study, policy=policy, evaluation=evaluation))
    np.testing.assert_array_equal(evaluation.thetas, np.full((2, policy.n_parameters), 0.5))


@pytest.mark.usefixtures("uncompiled")
def test_what_is_checked_keeps_to_the_policys_box(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the hardware, which may break, and in simulation."""
    study = simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF)
    policy, run, thetas = copy(study.policy), study.hardware.run, list[Array]()
    policy.bounds = (np.full(policy.n_parameters, 0.5), policy.bounds[1])

    def noted(policy: Policy, theta: Array, *others: Any) -> Rollout:
        thetas.append(theta)
        return run(policy, theta, *others)

    monkeypatch.setattr(study.hardware, "run", noted)
    narrow = replace(study, policy=policy)
    assert problems(narrow, "hardware") == []
    np.testing.assert_array_equal([*thetas, rollout(narrow).parameters], 0.5)


@pytest.mark.usefixtures("uncompiled")
def test_a_cost_is_asked_for_the_horizon_that_an_evaluation_simulates() -> None:
    study = simbias.load([*POINT_MASS, "tracking=none"], OWN_CONF)
    assert problems(replace(study, cost=Constant()), "cost") == []
    longer = simbias.load(
        [*POINT_MASS, "tracking=none", "evaluation=robust", "evaluation.seconds=3"], OWN_CONF
    )
    (problem,) = problems(replace(longer, cost=Constant()), "cost")
    assert "Constant" in problem
    assert "with_horizon" in problem


class Failing(Noting):
    """Predicts that every policy fails."""

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Any:
        def predicted(theta: Array) -> float:
            self.thetas.append(theta)
            return 2 * cost.max_cost

        return predicted


@pytest.mark.slow
def test_a_method_is_checked_by_a_short_trial() -> None:
    """However long its own are: on a model of many contacts they take minutes."""
    long = ["bias=none", "optimizer=nlopt_crs", "optimizer.max_evaluations=100000"]
    study = replace(
        simbias.load([*POINT_MASS, "tracking=none", *long], OWN_CONF), evaluation=(evaluation := Failing())
    )
    assert problems(study, "method") == []
    assert 0 < len(evaluation.thetas) < 1000
