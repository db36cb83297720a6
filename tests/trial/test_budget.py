"""One budget of experiments and seconds on hardware that every method obeys."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import pytest

from simbias.config import compose
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Budget, Study
from simbias.trial.summary import Outcome


def spending(study: Study, budget: Budget) -> Study:
    """A study that never succeeds."""
    method = ModelBased(max_iterations=5, experiments=2)
    never = copy(study.cost)
    never.max_cost = 1e-9
    return replace(study, method=method, cost=never, budget=budget)


def test_no_experiment_begins_once_it_is_spent(point_mass: Study, tmp_path: Path) -> None:
    for budget, made in ((Budget(experiments=3), 3), (Budget(seconds=1e-3), 1), (Budget(), 10)):
        study = spending(point_mass, budget)
        folder = tmp_path / str(made)
        record = run_trial(study, folder)
        assert record.outcome is Outcome.NOT_SUCCEEDED
        assert record.summary.experiments == made
        assert record.summary.max_experiments == (budget.experiments or 10)
        assert len(record.iterations) == made // 2
        again = read_trial(study, folder)
        assert (again.summary, len(again.unfinished)) == (record.summary, made % 2)


def test_no_budget_changes_no_identity() -> None:
    assert compose(["budget.experiments=null"]).hash == compose().hash
    assert compose(["budget.experiments=5"]).hash != compose().hash


def test_without_success_what_the_budget_allows_is_counted(point_mass: Study) -> None:
    summary = run_trial(spending(point_mass, Budget(experiments=3))).summary
    assert summary.experiments_until_success == pytest.approx(3)
