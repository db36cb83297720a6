"""The one way to run a trial: what is told to whom, in which order, and what its record says."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import isnan, nan
from typing import Any

import numpy as np
import pytest
from records import assert_equal, timeless
from threadpoolctl import threadpool_info, threadpool_limits

from simbias.core import HardwareError, Waiting
from simbias.core.records import Array, Iteration, Rollout
from simbias.trial.run import Outcome, Recorder, TrialRecord, run_trial
from simbias.trial.study import Method, Observer, Study


def rollout(cost: float = 0.0) -> Rollout:
    return Rollout(np.zeros((2, 2)), np.zeros((1, 1)), cost=cost)


def iteration(index: int, succeeded: bool = False) -> Iteration:
    return Iteration(index, np.zeros(3), (rollout(), rollout()), 0.0, succeeded, 2 * (index + 1))


class Scripted(Method):
    """Two iterations of two experiments, and what may happen in the second."""

    max_iterations = 5
    max_experiments = 10

    def __init__(self, succeeds: bool = True, breaks: BaseException | None = None) -> None:
        self._succeeds, self._breaks = succeeds, breaks

    def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
        for index in range(2):
            record = iteration(index, succeeded=self._succeeds and index == 1)
            observer.searching(10, 0.5)
            for number, each in enumerate(record.experiments):
                if (index, number) == (1, 1) and self._breaks is not None:
                    raise self._breaks
                observer.experimenting(record.parameters, each.states[0])
                observer.experimented(each)
            yield record


class Everything(Recorder, Observer):
    """Hears as a recorder and as an observer."""

    def __init__(self, pictures: tuple[str, ...] = ()) -> None:
        self.pictures = pictures
        self.heard: list[str] = []
        self.record: TrialRecord | None = None

    def recalling(self, study: Study) -> Study:
        self.heard.append("recalling")
        return study

    def searching(self, evaluations: int, best_cost: float) -> None:
        self.heard.append("searching")

    def experimenting(self, theta: Array, start: Array) -> None:
        self.heard.append("experimenting")

    def experimented(self, rollout: Rollout) -> None:
        self.heard.append("experimented")

    def iterated(self, iteration: Iteration) -> None:
        self.heard.append(f"iterated {iteration.index}")

    def ended(self, record: TrialRecord) -> None:
        self.heard.append(record.outcome)
        self.record = record

    def illustrated(self, pictures: Mapping[str, bytes]) -> None:
        self.heard.append(f"illustrated {sorted(pictures)}")


EXPERIMENTS = ["searching", "experimenting", "experimented", "experimenting", "experimented"]


def scripted(study: Study, **options: Any) -> Study:
    return replace(study, method=Scripted(**options))


def test_all_is_passed_on_in_order(point_mass: Study) -> None:
    """The recorder, first, hears of iterations and of the end; the observer of all that happens."""
    recorder, observer = Everything(), Everything()
    record = run_trial(scripted(point_mass), recorder, observer)
    assert recorder.heard == ["recalling", "iterated 0", "iterated 1", "succeeded"]
    assert observer.heard == [*EXPERIMENTS, "iterated 0", *EXPERIMENTS, "iterated 1"]
    both = Everything()
    run_trial(scripted(point_mass), both, both)
    assert both.heard[6:8] == ["iterated 0", "iterated 0"]
    assert recorder.record is record


def test_an_iteration_is_kept_before_anyone_sees_it(point_mass: Study) -> None:
    class Full(Recorder):
        def iterated(self, iteration: Iteration) -> None:
            raise OSError("disk full")

    observer = Everything()
    record = run_trial(scripted(point_mass), Full(), observer)
    assert observer.heard == EXPERIMENTS
    assert (record.outcome, record.reason) == (Outcome.ERROR, "OSError: disk full")
    assert record.experiments == 2


@pytest.mark.parametrize("succeeds", [True, False])
def test_a_record_of_a_trial_that_came_to_its_end(point_mass: Study, succeeds: bool) -> None:
    record = run_trial(scripted(point_mass, succeeds=succeeds))
    assert record.outcome is (Outcome.SUCCEEDED if succeeds else Outcome.NOT_SUCCEEDED)
    assert record.outcome.final
    assert [each.index for each in record.iterations] == [0, 1]
    assert (record.unfinished, record.reason, record.traceback, record.pictures) == ((), "", "", {})
    assert record.experiments == 4
    assert record.experiments_until_success == (4.0 if succeeds else 10.0)
    assert record.iterations_until_success == (2.0 if succeeds else 5.0)
    assert record.started > 0
    assert 0 < record.seconds < 5


@pytest.mark.parametrize(
    ("raised", "outcome", "reason"),
    [
        (Waiting("run.csv is\nnot there."), Outcome.WAITING, "run.csv is not there."),
        (HardwareError("hot"), Outcome.ERROR, "HardwareError: hot"),
        (SystemExit(), Outcome.ERROR, "SystemExit"),
        (asyncio.CancelledError(), Outcome.ERROR, "CancelledError"),
    ],
)
def test_a_record_of_a_trial_that_stopped(
    point_mass: Study, raised: BaseException, outcome: Outcome, reason: str
) -> None:
    recorder = Everything(pictures=("overview",))
    record = run_trial(scripted(point_mass, breaks=raised), recorder)
    assert (record.outcome, record.reason) == (outcome, reason)
    assert not record.outcome.final
    assert ("Traceback" in record.traceback) == (outcome is Outcome.ERROR)
    assert (len(record.iterations), len(record.unfinished), record.experiments) == (1, 1, 3)
    assert isnan(record.experiments_until_success)
    assert isnan(record.iterations_until_success)
    assert recorder.heard == ["recalling", "iterated 0", outcome]


@pytest.mark.parametrize("raised", [KeyboardInterrupt(), GeneratorExit()])
def test_an_interrupted_trial_is_kept_and_the_interruption_goes_on(
    point_mass: Study, raised: BaseException
) -> None:
    recorder = Everything()
    with pytest.raises(type(raised)):
        run_trial(scripted(point_mass, breaks=raised), recorder)
    assert recorder.heard == ["recalling", "iterated 0", "interrupted"]
    assert recorder.record is not None
    assert (recorder.record.experiments, recorder.record.reason) == (3, "")


def test_a_trial_without_an_iteration_does_not_succeed(point_mass: Study) -> None:
    class Nothing(Scripted):
        def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
            yield from ()

    record = run_trial(replace(point_mass, method=Nothing()))
    assert (record.outcome, record.experiments) == (Outcome.NOT_SUCCEEDED, 0)
    assert record.experiments_until_success == 10.0


def test_more_experiments_than_foreseen_are_not_hidden() -> None:
    record = TrialRecord(Outcome.NOT_SUCCEEDED, (iteration(0), iteration(1)), max_experiments=3)
    assert record.experiments_until_success == 4.0


@pytest.mark.parametrize("outcome", Outcome)
def test_only_what_would_come_again_is_final(outcome: Outcome) -> None:
    assert outcome.final == (outcome in ("succeeded", "not succeeded"))
    counted = TrialRecord(outcome, (iteration(0),), max_experiments=20).experiments_until_success
    expected = {"succeeded": 2.0, "not succeeded": 20.0}.get(outcome, nan)
    assert counted == pytest.approx(expected, nan_ok=True)


def test_pictures_are_drawn_once_the_trial_is_kept(
    point_mass: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    from simbias.pictures.trial import gallery

    def draw(study: Study, iterations: tuple[Iteration, ...], names: tuple[str, ...]) -> dict[str, bytes]:
        return {f"{name}.png": str(len(iterations)).encode() for name in names}

    monkeypatch.setattr(gallery, "pictures", draw)
    recorder = Everything(pictures=("overview", "costs"))
    study = scripted(point_mass)
    record = gallery.illustrated(study, run_trial(study, recorder), recorder)
    assert recorder.heard[-2:] == ["succeeded", "illustrated ['costs.png', 'overview.png']"]
    assert record.pictures == {"overview.png": b"2", "costs.png": b"2"}


def test_linear_algebra_runs_on_one_thread(point_mass: Study) -> None:
    seen = []

    class Looking(Observer):
        def iterated(self, iteration: Iteration) -> None:
            seen.append([pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"])

    with threadpool_limits(2, user_api="blas"):
        run_trial(scripted(point_mass), observer=Looking())
    assert seen
    assert all(threads and set(threads) == {1} for threads in seen)


@pytest.mark.slow
def test_a_trial_is_the_studys_run(point_mass: Study) -> None:
    """No recorder, no observer: the records are those that the study yields."""
    record = run_trial(point_mass)
    same = replace(record, iterations=tuple(point_mass.run()))
    assert_equal(timeless(record), timeless(same))
    assert record.max_experiments == point_mass.method.max_experiments
