"""What trials claim of their policies, and that such claims hold as often as they say."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS

import simbias
from simbias.core import Hardware
from simbias.core.records import Rollout
from simbias.trial.claim import ERROR, claim_of, error_of, passes_for
from simbias.trial.methods.model_based import ModelBased
from simbias.trial.run import run_trial
from simbias.trial.study import Study


class Fickle(Hardware):
    """Every policy passes with the same probability, whatever it does."""

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
    claim = claim_of(record.iterations[-1])
    assert claim.share == 1
    assert claim.low == pytest.approx(error_of(0) ** 0.5)
    assert record.summary.claimed_share == claim.low


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
