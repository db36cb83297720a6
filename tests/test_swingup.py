"""Swing-ups that no linear policy can do: found on the model, and judged by the task."""

from __future__ import annotations

import numpy as np
import pytest

import simbias
from simbias.trial.observer import Observer
from simbias.trial.steps import search

QUICK = ["evaluation=nominal_start", "optimizer.max_evaluations=3000"]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["acrobot_swingup", "pendubot_swingup"])
def test_a_search_swings_the_model_up(preset: str) -> None:
    study = simbias.load([f"preset={preset}", *QUICK])
    found = search(study, study.first_model(), np.random.default_rng(0), Observer())
    rollout = study.simulate(found.optimum.parameters)
    assert found.predicted_cost < 0.3  # 1 is the cost of hanging
    assert study.passes(rollout)
    assert study.task.error(rollout.states[-1], 8.0) == pytest.approx(np.zeros(4), abs=0.01)
    hanging = np.tile(study.task.start_mean, (study.task.horizon + 1, 1))
    assert study.task.succeeds(hanging) is False
