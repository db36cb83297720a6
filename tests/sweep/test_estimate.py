"""How long a sweep may take, before it is run."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import cast

import numpy as np
import pandas as pd
import pytest

from simbias.core import Cost, Evaluation, Model, Objective
from simbias.core.records import Array
from simbias.sweep.estimate import estimate
from simbias.sweep.grid import Sweep, expand
from simbias.trial.study import Study

SECONDS = 2e-3
NOTHING = pd.DataFrame({"hash": []})  # is finished


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    return expand(["+sweep=smoke", "tracking=none"])


class Slow(Evaluation):
    """A plain function of a policy, which counts no simulated steps."""

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """It takes so many seconds, whatever the policy."""
        return lambda theta: time.sleep(SECONDS) or 0.0


def test_a_plain_function_is_timed(sweep: Sweep, point_mass: Study) -> None:
    study = replace(point_mass, evaluation=Slow())
    made = estimate(sweep, NOTHING, study, 2)
    search = study.optimizer.max_evaluations * SECONDS
    assert 1 <= made.least / (search * len(sweep.trials) / 2) < 5  # on a busy machine
    assert made.most > 2 * made.least


class Counting(Evaluation):
    """An objective that simulates ten frames of each policy, in so many seconds."""

    steps = 0

    def objective(self, model: Model, cost: Cost, rng: np.random.Generator) -> Objective:
        """Itself, but for single policies."""
        return cast(Objective, self)

    def together(self, thetas: Array) -> Array:
        self.steps += 10 * len(thetas)
        time.sleep(SECONDS * len(thetas))
        return np.zeros(len(thetas))


def test_simulated_frames_are_timed(sweep: Sweep, point_mass: Study) -> None:
    """A search is as long as its policies last: for three quarters of the horizon."""
    study = replace(point_mass, evaluation=Counting(), task=point_mass.task.with_horizon(400))
    made = estimate(sweep, NOTHING, study, 1)
    search = study.optimizer.max_evaluations * 0.75 * 400 * SECONDS / 10
    assert 1 <= made.least / (search * len(sweep.trials)) < 5  # on a busy machine


def test_finished_trials_tell(sweep: Sweep, point_mass: Study) -> None:
    """Those of the same cell where there are any, else all of them."""
    first, *others = sweep.trials
    axis = sweep.axes[0].name
    rows = [{"hash": first.hash, axis: first.cell.labels[0], "seconds": 4.0}]
    made = estimate(sweep, pd.DataFrame(rows), point_mass, 2)
    assert made.least == made.most == 4.0 * len(others) / 2
    assert made.basis == "from 1 finished trial"
