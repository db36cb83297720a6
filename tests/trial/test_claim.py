"""What trials claim of their policies, as often as they say; and the budget that every method obeys."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS

import simbias
from simbias.core import Hardware
from simbias.core.records import Iteration, Rollout
from simbias.trial.budget import Budget, BudgetSpent, Spending
from simbias.trial.claim import ERROR, claim_of, error_of, passes_for
from simbias.trial.folder import TrialFolder
from simbias.trial.method import Method
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.observer import Observer
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome


class Fickle(Hardware):
    """Every policy passes with the same probability, whatever it does."""

    sets_start = False

    def __init__(self, share: float, horizon: int = 100) -> None:
        self._share, self._horizon = share, horizon

    def run(self, policy, theta, start, rng):
        passes = rng.random() < self._share
        states = np.full((self._horizon + 1, 2), 0.0 if passes else 0.9)
        return Rollout(states, np.zeros((self._horizon, 1)), *(() if passes else (self._horizon, "distance")))


def test_errors_of_all_policies_together_are_the_error() -> None:
    assert sum(map(error_of, range(100_000))) == pytest.approx(ERROR, rel=1e-4)
    assert [passes_for(0.8, policy) for policy in (0, 1, 4)] == [16, 22, 31]


def test_a_trial_goes_on_until_its_bound_holds(point_mass: Study) -> None:
    method = ModelBased(max_iterations=3, confidence=0.8)
    study = replace(point_mass, method=method, hardware=Fickle(1.0))
    record = run_trial(study)
    assert record.summary.experiments == 16
    assert record.summary.claimed_share > 0.8
    assert record.summary.claim == "holds 100% of starts (80% to 100%)"
    assert method.max_experiments == 16 + 22 + 26


def test_two_passes_claim_little(point_mass: Study) -> None:
    record = run_trial(replace(point_mass, method=ModelBased(), hardware=Fickle(1.0)))
    last = record.iterations[-1]
    assert (claim := claim_of(record.iterations))
    assert claim.share == 1
    assert claim.low == pytest.approx(error_of(0) ** 0.5)
    assert record.summary.claimed_share == claim.low
    at_mean = point_mass.experiment(np.zeros(3), np.random.default_rng(0), point_mass.task.start_mean)
    assert claim_of([replace(last, experiments=(at_mean, *last.experiments))]) is None  # not of drawn starts


def test_earlier_experiments_with_the_last_policy_count(point_mass: Study) -> None:
    """But not if it is designed on another model, or if the method chose the start."""
    last = run_trial(replace(point_mass, method=ModelBased(), hardware=Fickle(1.0))).iterations[-1]
    again, fell = replace(last, index=1), replace(last.experiments[0], failed_at=3)
    refuted = replace(last, experiments=(fell, fell))
    assert (alone := claim_of([again]))
    assert (claim := claim_of([refuted, again]))
    assert claim.low < min(alone.low, claim.share)
    assert (claim.share, claim.high) == (0.5, pytest.approx(1 - claim.low))
    passed = replace(last, experiments=10 * last.experiments)
    assert claim_of([passed, again]) == alone  # which its own passes support, however many it tried before
    assert last.model
    other = replace(last.model, policy=copy(last.model.policy), nominal=copy(last.model.nominal))
    chosen = replace(fell, given_start=True)
    for earlier in (replace(refuted, model=other), replace(last, experiments=(chosen,))):
        assert claim_of([earlier, again]) == alone


@pytest.mark.slow
def test_claims_are_wrong_at_most_as_often_as_they_say() -> None:
    """Of trials that try many policies, all of which hold 78%, at most one in twenty claims 80%."""
    method = ModelBased(max_iterations=10, confidence=0.8, stop_at_failure=True)
    short = ["tracking=none", "bias=none", "optimizer.max_evaluations=2", "task.horizon=2"]
    study = replace(simbias.load([*POINT_MASS, *short], OWN_CONF), method=method, hardware=Fickle(0.78, 2))
    wrong = [run_trial(replace(study, seed=seed)).summary.claimed_share > 0.78 for seed in range(30)]
    assert np.mean(wrong) < ERROR + 2 * np.sqrt(ERROR * (1 - ERROR) / len(wrong))


def test_a_trial_that_does_not_succeed_claims_nothing(point_mass: Study) -> None:
    record = run_trial(replace(point_mass, method=ModelBased(max_iterations=1), hardware=Fickle(0.0)))
    assert (record.summary.claim, np.isnan(record.summary.claimed_share)) == ("", True)


def test_seconds_that_are_spent_to_the_last_allow_no_more() -> None:
    """A sum of ten times 0.1 s in floating point is less than 1 s."""
    spent = Spending(Budget(seconds=1.0))
    for _ in range(10):
        spent.check()
        spent.add(1, 0.1)
    with pytest.raises(BudgetSpent):
        spent.check()


def spending(study: Study, budget: Budget) -> Study:
    """A study that never succeeds."""
    method = ModelBased(max_iterations=5, experiments=2)
    never = copy(study.cost)
    never.max_cost = 1e-9
    return replace(study, method=method, cost=never, budget=budget)


@pytest.mark.slow
def test_no_experiment_begins_once_it_is_spent(hasty: Study, tmp_path: Path) -> None:
    for budget, made in (
        (Budget(experiments=3), 3),
        (Budget(experiments=4), 4),
        (Budget(seconds=1e-3), 1),
        (Budget(), 10),
    ):
        study = spending(hasty, budget)
        folder = tmp_path / str(made)
        record = run_trial(study, folder)
        assert record.outcome is Outcome.NOT_SUCCEEDED
        assert record.summary.experiments == made
        assert record.summary.max_experiments == made  # also of a budget in seconds
        assert record.summary.experiments_until_success == made
        assert len(record.iterations) == made // 2
        unfinished = " policy had passed 0 of 1 experiment when the budget was spent."
        assert record.summary.reason.endswith(unfinished) == (made % 2 == 1)
        assert len(list(folder.glob("*_search.json"))) == (made + 1) // 2  # none whose policy cannot be tried
        again = read_trial(study, folder)
        assert (again.summary, len(again.unfinished)) == (record.summary, made % 2)


class Direct(Method):
    """It makes its experiments without the steps of methods."""

    max_iterations, experiments = 5, 1

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        """Experiments, and no iteration."""
        for experiment_rng in rng.spawn(5):
            study.experiment(np.zeros(3), experiment_rng)
        yield from ()


def test_a_method_that_goes_its_own_way_is_stopped_too(point_mass: Study, tmp_path: Path) -> None:
    study = replace(point_mass, method=Direct(), budget=Budget(experiments=3))
    run_trial(study, tmp_path)
    assert len(TrialFolder(tmp_path).steps()) == 3
