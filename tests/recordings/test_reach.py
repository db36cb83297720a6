"""Recordings that reach beyond what a model was learned from are told."""

from dataclasses import replace

import numpy as np
import pytest
from pendulum import experiment, pendulum, truth

from simbias.core.records import Rollout
from simbias.recordings.reach import beyond


@pytest.fixture(scope="module")
def rollouts() -> list[Rollout]:
    study = pendulum()
    model, _ = truth(study.nominal, np.random.default_rng(4))
    return [experiment(model, np.random.default_rng(seed)) for seed in (1, 2)]


def test_other_positions_do_and_motion_of_a_kind_does_not(rollouts: list[Rollout]) -> None:
    task, turned = pendulum().task, rollouts[0].states + np.array([20.0, 0.0, 0.0, 0.0])
    assert beyond(task, rollouts[:1], rollouts[1:]) == beyond(task, rollouts, rollouts) == []
    (found,) = beyond(task, [replace(rollouts[0], states=turned)], rollouts)
    assert (found.name, found.share) == (task.states[0].name, 1.0)


def test_stronger_inputs_do(rollouts: list[Rollout]) -> None:
    """Inputs three times as large, in half of the frames or in a few."""
    task, first = pendulum().task, rollouts[0]
    stronger = np.where(np.arange(first.frames)[:, None] % 2 == 0, 3.0, 1.0) * first.inputs
    found = beyond(task, [replace(first, inputs=stronger)], [first])
    assert {each.name for each in found} == {each.name for each in task.inputs}
    for each in found:
        assert each.range == pytest.approx(np.multiply(3.0, each.learned), rel=0.1)
        assert 0.15 < each.share < 0.5
    few = np.where(np.arange(first.frames)[:, None] < 0.1 * first.frames, 3.0, 1.0) * first.inputs
    assert beyond(task, [replace(first, inputs=few)], [first]) == []
