"""The paper's premise: a policy of the nominal model alone fails on hardware; Algorithm 1's does not."""

import pytest
from premise import balanced_starts

from simbias.core.records import Iteration
from simbias.trial.study import Study

pytestmark = pytest.mark.slow

STARTS = 8


@pytest.fixture(scope="module")
def iterations(study: Study) -> list[Iteration]:
    """Those of one trial without noise; sweeps/results/premise has ten."""
    return list(study.run())


def test_learning_the_bias_makes_the_policy_work(study: Study, iterations: list[Iteration]) -> None:
    first, last = iterations[0], iterations[-1]
    assert last.succeeded
    assert last.total_experiments <= 8
    assert balanced_starts(study, first.parameters, STARTS) <= STARTS / 2
    assert balanced_starts(study, last.parameters, STARTS) > STARTS / 2


def test_first_policy_balances_the_model_that_it_was_searched_on(
    study: Study, iterations: list[Iteration]
) -> None:
    """It is the hardware that it fails on (Fig. 4); Z = 3.0 is what an independent prototype found."""
    first = iterations[0]
    assert study.simulate(first.parameters).failed_at is None
    assert first.search is not None
    assert round(first.search.predicted_cost, 1) == 3.0
    assert not first.succeeded
