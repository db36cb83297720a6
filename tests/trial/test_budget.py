"""One budget of experiments and seconds on hardware that every method obeys."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simbias.core.records import Iteration
from simbias.trial.budget import Budget
from simbias.trial.folder import TrialFolder
from simbias.trial.method import Method
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.observer import Observer
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome


def spending(study: Study, budget: Budget) -> Study:
    """A study that never succeeds."""
    method = ModelBased(max_iterations=5, experiments=2)
    never = copy(study.cost)
    never.max_cost = 1e-9
    return replace(study, method=method, cost=never, budget=budget)


@pytest.mark.slow
def test_no_experiment_begins_once_it_is_spent(point_mass: Study, tmp_path: Path) -> None:
    for budget, made in (
        (Budget(experiments=3), 3),
        (Budget(experiments=4), 4),
        (Budget(seconds=1e-3), 1),
        (Budget(), 10),
    ):
        study = spending(point_mass, budget)
        folder = tmp_path / str(made)
        record = run_trial(study, folder)
        assert record.outcome is Outcome.NOT_SUCCEEDED
        assert record.summary.experiments == made
        assert record.summary.max_experiments == (budget.experiments or 10)
        assert record.summary.experiments_until_success == (budget.experiments or 10)
        assert len(record.iterations) == made // 2
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
