"""The test of the last policy: apart from the trial, from the same starts for all seeds."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from point_mass import InTheWind
from records import assert_equal, timeless

import simbias
from simbias.core import HardwareError
from simbias.core.records import Rollout
from simbias.lab.checked_hardware import ExperimentConditions
from simbias.trial.folder import EPISODES
from simbias.trial.observer import Observer
from simbias.trial.policy_test import Episode, PolicyTest, PolicyTestResult, episodes_csv, run_policy_test
from simbias.trial.run import run_trial
from simbias.trial.study import Study

pytestmark = pytest.mark.usefixtures("uncompiled")

SHORT = [*POINT_MASS, "tracking=none", "optimizer.max_evaluations=20", "method.max_iterations=1"]


def study(*overrides: str) -> Study:
    return simbias.load([*SHORT, *overrides], OWN_CONF)


@pytest.mark.slow
def test_it_changes_nothing_in_a_trial() -> None:
    plain = study()
    tested = study("policy_test.episodes=3", "policy_test.long_episodes=1", "policy_test.long_seconds=3")
    assert plain.hash == tested.hash
    without, record = timeless(run_trial(plain)), timeless(run_trial(tested))
    assert without.policy_test is None
    assert record.policy_test is not None
    summary = without.summary
    names = [*("test_episodes", "lasting_episodes", "holding_episodes", "success_rate")]
    names += ["long_success_rate", "long_seconds"]
    same = replace(record.summary, **{name: getattr(summary, name) for name in [*names, "test_words"]})
    assert_equal(replace(record, policy_test=None, summary=same), without)
    frames = [each.frames for iteration in without.iterations for each in iteration.experiments]
    assert summary.hardware_seconds == pytest.approx(plain.task.time_step * sum(frames))


@pytest.mark.slow
def test_a_trial_that_has_ended_without_it_stays_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One line says so, and nothing is written."""
    ended = run_trial(study(), tmp_path)
    files = sorted(tmp_path.iterdir())
    again = run_trial(study("policy_test.episodes=3"), tmp_path)
    assert (again.summary, again.policy_test) == (ended.summary, None)
    assert "ended without what this command asks for" in caplog.text
    assert sorted(tmp_path.iterdir()) == files


@pytest.mark.slow
def test_its_file_is_written_anew_where_it_was_damaged(tmp_path: Path) -> None:
    """But not by a command that asks for another test."""
    tested = ("policy_test.episodes=3", "policy_test.long_episodes=1", "policy_test.long_seconds=3")
    run_trial(study(*tested), tmp_path)
    right = (tmp_path / EPISODES).read_bytes()
    (tmp_path / EPISODES).write_bytes(right[:-9])
    run_trial(study(*tested[:2], "policy_test.long_seconds=4"), tmp_path)
    assert (tmp_path / EPISODES).read_bytes() == right[:-9]
    run_trial(study(*tested), tmp_path)
    assert (tmp_path / EPISODES).read_bytes() == right


@pytest.mark.slow
def test_what_raises_in_an_episode_is_said_to_be_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def unplugged(*_: Any) -> Rollout:
        raise HardwareError("unplugged")

    class Unplugging(Observer):
        def trying(self, number: int, count: int) -> None:
            if number == 1:
                monkeypatch.setattr(InTheWind, "run", unplugged)

    record = run_trial(study("policy_test.episodes=3"), observer=Unplugging())
    assert record.summary.reason == "test episode 2 of 3: HardwareError: unplugged"


def test_its_starts_are_those_of_every_seed_and_its_episodes_are_experiments() -> None:
    one, other = study("seed=1"), study("seed=2")
    theta = np.full(one.policy.n_parameters, -3.0)
    results = [run_policy_test(each, theta, PolicyTest(4, long_episodes=0)) for each in (one, other)]
    assert results[0] is not None
    assert_equal(results[0], results[1])
    for found, rng in zip(results[0].episodes, np.random.default_rng(2015).spawn(4), strict=True):
        rollout = one.experiment(theta, rng)
        assert np.array_equal(found.start, rollout.states[0])
        assert found.failure == rollout.failure
        assert found.seconds == pytest.approx(rollout.frames * one.task.time_step)


def test_the_first_episodes_may_last_beyond_the_horizon() -> None:
    point_mass = study()
    horizon = point_mass.task.horizon * point_mass.task.time_step
    theta = np.zeros(point_mass.policy.n_parameters)
    result = run_policy_test(point_mass, theta, PolicyTest(3, long_episodes=2, long_seconds=2.5 * horizon))
    assert result is not None
    assert [each.asked_seconds for each in result.episodes] == pytest.approx([2.5 * horizon] * 2 + [horizon])
    assert all(each.seconds <= each.asked_seconds + 1e-9 for each in result.episodes)
    asked: list[int] = []
    asking = ExperimentConditions(confirm=True, ask=lambda *asked_for: not asked.append(asked_for[-1]))
    run_policy_test(replace(point_mass, conditions=asking), theta, PolicyTest(3, 2, 2.5 * horizon))
    assert asked == [2.5 * point_mass.task.horizon]  # once, with the duration of that episode
    short = run_policy_test(point_mass, theta, PolicyTest(3, long_episodes=3, long_seconds=0.5 * horizon))
    assert short is not None
    assert short.long_episodes == ()


def test_its_result_in_numbers_and_words() -> None:
    x, failure = np.zeros(2), "distance"
    ends = ((60.0, 60.0, None), (60.0, 7.0, failure), (5.0, 3.0, failure))
    episodes = tuple(Episode(x, *end, errors=(0.5, 2.0)) for end in ends)
    result = PolicyTestResult(5.0, episodes)
    assert result.successes == "110"
    in_last_frame = tuple(Episode(x, seconds, 5.0, failure) for seconds in (60.0, 5.0))
    assert PolicyTestResult(5.0, in_last_frame).successes == "00"
    assert PolicyTestResult(5.0, episodes[:2]).holding == "11"  # where all are long, too
    numbers = (result.success_rate, result.long_success_rate, result.long_seconds)
    assert numbers == pytest.approx((2 / 3, 0.5, 33.5))
    counts, lasts = "in 2 of 3 (21% to 94%) test episodes", ", and lasts in 1 of 2 (9% to 91%) of 60 s ("
    assert f"Its last policy lasts without a failure {counts} of 5 s{lasts}" in result.words
    own = PolicyTestResult(5.0, tuple(each._replace(succeeds=each.seconds > 5) for each in episodes))
    assert f"Its last policy succeeds {counts} (of 5 s: 0 of 1; of 60 s: 2 of 2){lasts}" in own.words
    assert "they last 34 s on average" in result.words
    shares = tuple(each._replace(uptime=share) for each, share in zip(episodes, (0.5, 0.3, 0.1), strict=True))
    up = PolicyTestResult(5.0, shares)
    assert up.words == result.words.replace(" on average).", " on average); mean uptime 10% in 5 s.")
    assert PolicyTestResult(5.0, shares[:2]).uptime == pytest.approx(0.4)
    table = episodes_csv(up, study().task).splitlines()
    assert [row.rsplit(",", 1)[1] for row in table] == ["uptime", "0.5", "0.3", "0.1"]
    rows = episodes_csv(result, study().task).splitlines()
    ended = "asked_seconds,lasted_seconds,failure,succeeded"
    assert rows[0].endswith(f"{ended},position_rms_error,velocity_rms_error")
    assert [row.split(",", 2)[2] for row in rows[1:]] == [
        f"{end},0.5,2" for end in ("60,60,,1", "60,7,distance,1", "5,3,distance,0")
    ]
