"""What the last policy is worth: tried apart, changing nothing, and made but once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import OWN_CONF, POINT_MASS
from records import assert_equal, timeless

import simbias
from simbias.core import Hardware, Policy, Waiting
from simbias.core.records import Array, Rollout
from simbias.mlflow.fields import holds, trial_metrics
from simbias.sweep.tables import attainable_starts
from simbias.trial.files import held_out_text
from simbias.trial.journal import Journal
from simbias.trial.policy_test import SEED, Tries, Try, try_policy
from simbias.trial.run import Outcome, run_trial
from simbias.trial.study import HeldOut, Study

SHORT = [*POINT_MASS, "tracking=none", "optimizer.max_evaluations=20", "method.max_iterations=1"]


def study(*overrides: str) -> Study:
    return simbias.load([*SHORT, *overrides], OWN_CONF)


class Slow(Hardware):
    """Whose every other result is there only when it is asked for again."""

    def __init__(self, hardware: Hardware) -> None:
        self._hardware = hardware
        self.asked = self.made = 0

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        self.asked += 1
        if self.asked % 2:
            raise Waiting("not there yet")
        self.made += 1
        return self._hardware.run(policy, theta, start, rng)


def test_the_tries_change_nothing_in_a_trial() -> None:
    plain, tries = study(), study("held_out.starts=3", "held_out.lasting=1", "held_out.seconds=9")
    assert plain.hash == tries.hash
    without, with_tries = run_trial(plain), run_trial(tries)
    assert without.held_out is None
    assert with_tries.held_out is not None
    assert_equal(timeless(replace(with_tries, held_out=None)), timeless(without))
    frames = [each.frames for iteration in without.iterations for each in iteration.experiments]
    assert without.hardware_seconds == pytest.approx(plain.task.time_step * sum(frames))


def test_the_starts_are_those_of_every_seed_and_the_tries_are_experiments() -> None:
    one, other = study("seed=1"), study("seed=2")
    theta = np.array([-3.0, -3.0])[: one.policy.n_parameters]
    theta = np.resize(theta, one.policy.n_parameters)
    tries = [try_policy(each, theta, HeldOut(4, lasting=0)) for each in (one, other)]
    assert tries[0] is not None
    assert_equal(tries[0], tries[1])
    rngs = np.random.default_rng(SEED).spawn(4)
    for found, rng in zip(tries[0].each, rngs, strict=True):
        rollout = one.experiment(theta, rng)
        assert np.array_equal(found.start, rollout.states[0])
        assert found.failure == rollout.failure
        assert found.seconds == pytest.approx(rollout.frames * one.task.time_step)


def test_the_first_ones_go_on_beyond_the_horizon() -> None:
    point_mass = study()
    horizon = point_mass.task.horizon * point_mass.task.time_step
    theta = np.zeros(point_mass.policy.n_parameters)
    tries = try_policy(point_mass, theta, HeldOut(3, lasting=2, seconds=2.5 * horizon))
    assert tries is not None
    assert [each.asked for each in tries.each] == pytest.approx([2.5 * horizon] * 2 + [horizon])
    assert all(each.seconds <= each.asked + 1e-9 for each in tries.each)
    assert try_policy(point_mass, theta, HeldOut(3, lasting=3, seconds=0.5 * horizon)).going_on == ()  # type: ignore[union-attr]


def test_no_try_is_made_twice(tmp_path: Path) -> None:
    """The trial waits for every result once, also for those of the tries."""
    asked = study("held_out.starts=3", "held_out.lasting=0")
    undisturbed = timeless(run_trial(asked))
    hardware = Slow(asked.hardware)
    for _ in range(20):
        record = run_trial(replace(asked, hardware=hardware), Journal(tmp_path / "trial"))
        if record.outcome is not Outcome.WAITING:
            break
    assert_equal(timeless(record), undisturbed)
    assert hardware.made == undisturbed.experiments + 3


def test_what_is_told_of_tries() -> None:
    x = np.zeros(2)
    each = (Try(x, 60.0, 60.0, None), Try(x, 60.0, 7.0, "distance"), Try(x, 5.0, 3.0, "distance"))
    tries = Tries(5.0, each)
    assert tries.holds == (True, True, False)
    assert (tries.held, tries.lasted, tries.seconds) == pytest.approx((2 / 3, 0.5, 33.5))
    assert "2 of 3 held-out starts for 5 s, and 1 of 2 for 60 s (34 s on average)" in tries.words
    record = replace(run_trial(study()), held_out=tries)
    assert holds(record) == "110"
    numbers = trial_metrics(record)
    assert numbers["held_out/held"] == pytest.approx(2 / 3)
    assert numbers["held_out/lasted"] == 0.5
    rows = held_out_text(tries, study().task).splitlines()
    assert rows[0].endswith("asked_seconds,lasted_seconds,failure")
    assert [row.split(",", 2)[2] for row in rows[1:]] == ["60,60,", "60,7,distance", "5,3,distance"]


def test_a_start_that_no_policy_holds_counts_against_none() -> None:
    def of(*texts: str) -> list[bool]:
        return attainable_starts(pd.DataFrame({"held_out": list(texts)}))

    assert of("110", "", "100") == [True, True, False]
    assert of("000", "000") == [True] * 3
    assert of("", "") == []
