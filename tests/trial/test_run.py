"""The one way to run a trial: what observers hear, what its record says; a notebook as the hardware."""

import asyncio
import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from errors import one_line
from records import assert_equal
from scripted import Listener
from threadpoolctl import threadpool_info, threadpool_limits

from simbias.core import HardwareError, Waiting
from simbias.core.records import Iteration, Rollout
from simbias.lab.requests.request import ExperimentRequest
from simbias.trial.method import Method
from simbias.trial.observer import Observer, Observers
from simbias.trial.run import read_trial, run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary


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


EXPERIMENTS = ["searching", *2 * ["experimenting", "experimented"]]


def scripted(study: Study, **options: Any) -> Study:
    return replace(study, method=Scripted(**options))


def test_observers_hear_all_in_order(point_mass: Study) -> None:
    one, other = Listener(), Listener()
    run_trial(scripted(point_mass), observer=Observers(one, other))
    for each in (one, other):
        assert [name for name, _ in each.heard] == 2 * [*EXPERIMENTS, "iterated"]
        assert [what for name, what in each.heard if name == "iterated"] == [0, 1]


def test_an_iteration_is_kept_before_anyone_sees_it(
    point_mass: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError("disk full")

    observer = Listener()
    monkeypatch.setattr("simbias.trial.step_files.StepFiles.append", full)
    record = run_trial(scripted(point_mass), tmp_path, observer)
    assert [name for name, _ in observer.heard] == EXPERIMENTS
    assert (record.outcome, record.summary.reason) == (Outcome.ERROR, "OSError: disk full")
    assert record.summary.experiments == 2


def test_a_trial_that_ended(point_mass: Study) -> None:
    for succeeds in (True, False):
        record = run_trial(scripted(point_mass, succeeds=succeeds))
        summary = record.summary
        assert summary.outcome is (Outcome.SUCCEEDED if succeeds else Outcome.NOT_SUCCEEDED)
        assert [each.index for each in record.iterations] == [0, 1]
        assert (record.unfinished, summary.reason, record.traceback) == ((), "", "")
        assert summary.experiments == 4
        assert summary.experiments_until_success == (4.0 if succeeds else 10.0)
        assert summary.iterations_until_success == (2.0 if succeeds else 5.0)
        assert 0 < summary.seconds < 5
    more = TrialSummary(Outcome.NOT_SUCCEEDED, experiments=4, max_experiments=3)
    assert more.experiments_until_success == 4.0  # none is hidden


@pytest.mark.slow
def test_a_trial_that_stopped(point_mass: Study, tmp_path: Path) -> None:
    """It is read back as far as it went, though its method raises again."""
    for number, (raised, outcome, reason) in enumerate(
        [
            (Waiting("run.csv is\nnot there."), Outcome.WAITING, "run.csv is not there."),
            (HardwareError("hot"), Outcome.ERROR, "HardwareError: hot"),
            (SystemExit(), Outcome.ERROR, "SystemExit"),
            (asyncio.CancelledError(), Outcome.ERROR, "CancelledError"),
        ]
    ):
        study = scripted(point_mass, breaks=raised)
        record = run_trial(study, tmp_path / str(number))
        summary = record.summary
        assert (summary.outcome, summary.reason) == (outcome, reason)
        assert ("Traceback" in record.traceback) == (outcome is Outcome.ERROR)
        assert (len(record.iterations), len(record.unfinished), summary.experiments) == (1, 1, 3)
        assert isnan(summary.experiments_until_success)
        assert isnan(summary.iterations_until_success)
        assert_equal(read_trial(study, tmp_path / str(number)), record)


def test_an_interrupted_trial_is_kept_and_the_interruption_passed_on(
    point_mass: Study, tmp_path: Path
) -> None:
    for raised in (KeyboardInterrupt(), GeneratorExit()):
        folder = tmp_path / type(raised).__name__
        with pytest.raises(type(raised)):
            run_trial(scripted(point_mass, breaks=raised), folder)
        record = read_trial(scripted(point_mass, breaks=Waiting()), folder)
        assert (record.outcome, record.summary.experiments, record.summary.reason) == ("interrupted", 3, "")


def test_a_method_without_an_iteration_is_an_error(point_mass: Study) -> None:
    class Nothing(Scripted):
        def run(self, study: Study, rng: np.random.Generator, observer: Observer) -> Iterator[Iteration]:
            yield from ()

    summary = run_trial(replace(point_mass, method=Nothing())).summary
    assert (summary.outcome, summary.reason) == (Outcome.ERROR, "method: Nothing.run yields no iteration")


def test_a_summary_is_the_same_after_json() -> None:
    for summary in (
        TrialSummary(Outcome.ERROR, reason="a | b\n"),
        TrialSummary(Outcome.SUCCEEDED, success_rate=0.5, platforms=("a", "b"), diagnostics=("c",)),
    ):
        assert_equal(TrialSummary.from_json(json.loads(json.dumps(summary.as_json()))), summary)
    whole = TrialSummary(Outcome.ERROR).as_json()
    for wrong, words in (
        ({}, "^lacks experiments, iterations, "),
        ({name: each for name, each in whole.items() if name != "iterations"}, "^lacks iterations$"),
        (whole | {"outcome": "fine"}, "^outcome: Input should be"),
        (whole | {"experiments": "many"}, "^experiments: Input should be"),
    ):
        with one_line(words, ValueError):
            TrialSummary.from_json(wrong)


def test_linear_algebra_runs_on_one_thread(point_mass: Study) -> None:
    seen = []

    class Looking(Observer):
        def iterated(self, iteration: Iteration) -> None:
            seen.append([pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"])

    with threadpool_limits(2, user_api="blas"):
        run_trial(scripted(point_mass), observer=Looking())
    assert seen
    assert all(threads and set(threads) == {1} for threads in seen)


def made(study: Study, request: ExperimentRequest) -> Rollout:
    """The experiment, made with the controller alone."""
    task, controller = study.task, request.controller()
    states, inputs = [request.start], []
    while len(inputs) < task.horizon and task.failure(states[-1]) is None:
        inputs.append(controller(states[-1]))
        states.append(study.nominal.step(states[-1], inputs[-1] + 2.0))  # the wind
    failure = task.failure(states[-1])
    return Rollout(np.array(states), np.array(inputs), None if failure is None else len(inputs), failure)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_a_trial_that_is_told_is_the_one_that_runs(point_mass: Study) -> None:
    asked = 0
    vars(point_mass.policy)["targets"] = np.ones(2)  # set points, say: the task has none
    while (request := point_mass.ask()) is not None:
        assert point_mass.ask() is request  # until it is told
        point_mass.tell(made(point_mass, request))
        asked += 1
    by_itself = list(point_mass.run())
    told = point_mass.ask_tell.iterations
    assert len(told) == len(by_itself) > 1
    assert by_itself[-1].succeeded  # in the wind, which the nominal model does not know
    assert asked == by_itself[-1].total_experiments
    for one, other in zip(told, by_itself, strict=True):
        np.testing.assert_array_equal(one.parameters, other.parameters)
        assert (one.hardware_cost, one.succeeded) == (other.hardware_cost, other.succeeded)
        assert one.experiments[0].states.shape == other.experiments[0].states.shape
    assert point_mass.ask() is None


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
def test_what_is_wrong_is_told_and_the_question_stays_open(
    point_mass: Study, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(ValueError, match=r"call ask\(\) first"):
        point_mass.tell(Rollout(np.zeros((1, 2)), np.zeros((0, 1)), 0, "fell"))
    request = point_mass.ask()
    assert request is not None
    whole = made(point_mass, request)
    with pytest.raises(HardwareError, match=r"states: expected the shape \(101, 2\), got \(101, 1\)"):
        point_mass.tell(replace(whole, states=whole.states[:, :1]))
    with pytest.raises(HardwareError, match=r"^study\.tell: states: expected position to begin at "):
        point_mass.tell(replace(whole, states=whole.states + 10.0))
    assert point_mass.ask() is request
    point_mass.tell(whole)
    request = point_mass.ask()
    answers = point_mass.ask_tell._answers
    answers[0] = (
        replace(answers[0][0], theta=request.theta + 1.0),
        answers[0][1],
    )  # as if it was of another policy
    with pytest.raises(HardwareError, match=r"^study\.tell: is the answer to another request, that of exper"):
        point_mass.tell(whole)
    assert point_mass.ask() is request
    answers[0] = replace(answers[0][0], theta=request.theta), answers[0][1]  # a robot without noise
    point_mass.tell(whole)
    assert "study.tell: got the rollout of experiment 1 again" in caplog.text


@pytest.mark.parametrize("start", [np.array([0.1]), np.zeros(3), 0.1])
def test_a_policy_or_start_of_another_shape_is_one_line(point_mass: Study, start: Any) -> None:
    theta, rng = np.zeros(3), np.random.default_rng(0)
    for run in (point_mass.simulate, partial(point_mass.experiment, rng=rng)):
        with pytest.raises(ValueError, match=r"^start: expected the shape \(2,\), got \("):
            run(theta, start=start)
        with pytest.raises(ValueError, match=r"^theta: expected the shape \(3,\), got \(4,\)$"):
            run(np.zeros(4))
