"""The one way to run, resume and read back a trial: its method runs over the steps in its folder."""

from __future__ import annotations

import logging
import time
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

from threadpoolctl import threadpool_limits

from simbias.core import Controller, Waiting, platform
from simbias.core.digest import short_digest
from simbias.core.error_origin import has_own_code, with_origin
from simbias.core.errors import ConfigError
from simbias.core.messages import counted, with_trace, with_type, words
from simbias.core.records import Iteration, Rollout
from simbias.lab.requests.request import ExperimentRequest
from simbias.lab.safety import SafetyLimitedPolicy
from simbias.trial import diagnostics
from simbias.trial.claim import claim_of, iterations_with
from simbias.trial.disk import LOCK, is_locked
from simbias.trial.folder import TRIAL, Withdrawal
from simbias.trial.observer import Observer, Observers
from simbias.trial.policy_test import PolicyTestResult, episodes_csv, run_policy_test
from simbias.trial.record import FolderRecord
from simbias.trial.replay import EndOfRecord
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

ENDED = "simbias: trial %s ended without what this command asks for, such as a test; seed=N starts another"


@dataclass(frozen=True, eq=False)
class TrialRecord:
    """The record of a trial, up to its end or to where it stopped."""

    study: Study  #: as it was run
    summary: TrialSummary  #: its numbers in a row
    iterations: tuple[Iteration, ...]  #: finished iterations
    unfinished: tuple[Rollout, ...] = ()  #: experiments of the unfinished iteration
    policy_test: PolicyTestResult | None = None  #: of the last policy, if requested
    traceback: str = ""  #: empty for a bad key or file, which the reason names
    withdrawn: tuple[Withdrawal, ...] = ()  #: experiments that a person withdrew
    changed_code: str = ""  #: the user's modules and files that changed since it began, if read from a folder

    def __repr__(self) -> str:
        """The trial in a line, e.g. in a notebook."""
        return f"<trial {self.study.hash}: {self.outcome.verdict} after {self.summary.effort}>"

    @property
    def outcome(self) -> Outcome:
        """How the trial ended or stopped."""
        return self.summary.outcome

    @property
    def next_experiment(self) -> ExperimentRequest:
        """Another experiment with the last policy, as designed in its iteration, from the mean start.

        Model-based parts of the policy, such as an observer's gains, come from that iteration's model; in the
        study's own policy they come from the nominal model.

        Raises
        ------
        ConfigError
            If no iteration has ended.
        """
        if not self.iterations:
            raise ConfigError("trial", "has no policy yet, as no iteration has ended")
        last, task, safety = self.iterations[-1], self.study.task, self.study.conditions.safety
        policy = self.study.designed_on(last.model).policy
        if safety.limits:
            policy = SafetyLimitedPolicy(policy, task, safety.bounds(task))
        return ExperimentRequest(task, policy, last.parameters, task.start_mean)

    def controller(self) -> Controller:
        """The controller of the last policy, within `hardware.safety`; errors as for `next_experiment`.

        >>> controller = simbias.load_trial("trials/7a29f4c5425f").controller()
        >>> u = controller(x)  # in each frame, from the first of an episode
        """
        return self.next_experiment.controller()


def run_trial(study: Study, folder: Path | None = None, observer: Observer | None = None) -> TrialRecord:
    """Run a trial, resume it where it stopped, or replay it if it has ended.

    Steps in the folder are not repeated; later steps are as in an uninterrupted trial, to the last bit on one
    platform. Errors of components are reported in the record. Without a folder, nothing is kept. Linear
    algebra runs on one thread, as more would change the last bits of a factorisation.

    ConfigError if the method cannot work with a component; if the folder cannot be written, belongs to
    another trial, lacks a readable trial.json or changes meanwhile; if a finished trial cannot be replayed;
    or if another process runs this trial. KeyboardInterrupt when interrupted; completed steps are kept.
    """
    study.check()
    kept = None if folder is None else FolderRecord(folder, study)
    run = _Run(study, kept, observer or Observer())
    with threadpool_limits(1, user_api="blas"), kept.opened() if kept else nullcontext():
        try:
            run.run()
            record = run.record(*run.ended)
        except EndOfRecord:
            logging.getLogger(__name__).warning(ENDED, study.hash)
            record = run.record(Outcome.NOT_SUCCEEDED)  # replaced by its recorded outcome
        except Waiting as reason:
            record = run.record(Outcome.WAITING, f"{run.episode}{words(reason)}")
        except (KeyboardInterrupt, GeneratorExit):
            with suppress(ConfigError):  # also if the folder is gone
                run.stop(run.record(Outcome.INTERRUPTED))
            raise
        except BaseException as error:  # also SystemExit, and what other libraries raise to end tasks
            if kept is not None and kept.folder.ended:  # a finished trial that is replayed
                if isinstance(error, ConfigError):
                    raise
                raise ConfigError(
                    str(kept.folder.path / TRIAL), f"cannot be read ({with_type(error)})"
                ) from error
            trace = "" if isinstance(error, ConfigError) and not has_own_code(error) else with_trace(error)
            record = run.record(Outcome.ERROR, f"{run.episode}{with_origin(error)}", trace)
        return run.stop(record)


def read_trial(study: Study, folder: Path) -> TrialRecord:
    """Read back a trial, even a running one, by replaying its folder.

    ConfigError if a step cannot be read or does not fit the study, or the outcome's counts of experiments or
    iterations are wrong.
    """
    kept = FolderRecord(folder, study)
    run = _Run(study, kept, Observer())
    with threadpool_limits(1, user_api="blas"), suppress(EndOfRecord):
        try:
            run.run()
        except (EndOfRecord, ConfigError, KeyboardInterrupt, GeneratorExit):
            raise
        except BaseException:  # a component may fail as it did when the trial stopped
            if kept.folder.ended:
                raise
    record = run.record(Outcome.INTERRUPTED)
    if (summary := kept.summary(record.summary)) is None:  # it is running, or was killed
        summary = replace(
            record.summary,
            outcome=Outcome.RUNNING if is_locked(folder / LOCK) else Outcome.INTERRUPTED,
            ended=nan,
            seconds=kept.seconds_before,
            platforms=tuple(kept.folder.platforms()),
            processor="",
        )
    return replace(record, summary=summary)


class _Run(Observer):
    """A running trial, and its progress so far."""

    def __init__(self, study: Study, kept: FolderRecord | None, observer: Observer) -> None:
        self._study, self._kept = study, kept
        self._observers = Observers(self, observer)
        self._clock = time.perf_counter()
        self._iterations: list[Iteration] = []
        self._made: list[Rollout] = []
        self._unfinished: list[Rollout] = []
        self._policy_test: PolicyTestResult | None = None
        self.episode = ""  # the current test episode, as the beginning of a reason

    def run(self) -> None:
        """Run the method, then the test of its last policy."""
        study = self._study if self._kept is None else self._study.over(self._kept)
        for iteration in study.run(self._observers):
            if self._kept is not None:
                iteration = self._kept.iteration(iteration, self._iterations)
            self._observers.iterated(iteration)
        if self._iterations:
            last, trying = self._iterations[-1], self._observers.trying
            designed, theta = study.designed_on(last.model), last.parameters
            if self._kept is not None:
                self._kept.testing = True
            self._policy_test = run_policy_test(designed, theta, study.policy_test, trying)
        if self._kept is not None:
            self._kept.check_end()

    @property
    def ended(self) -> tuple[Outcome, str]:
        """The outcome by the last iteration's policy on the hardware, and the reason if it did not pass."""
        last = self._iterations[-1] if self._iterations else None
        if last is not None and last.succeeded:
            return Outcome.SUCCEEDED, ""
        same = iterations_with(last.parameters, last.model, self._iterations) if last else []
        tried = [rollout for each in same for rollout in each.experiments]
        why = "; ".join(diagnostics.of_experiments(tried, self._study))
        told = [f"Of the last policy, {why}."] if why else []
        if self._unfinished:
            drawn, made = self._study.method.split(self._unfinished, first=last is None)
            passed = f"{sum(map(self._study.passes, made))} of {counted(len(made), 'experiment')}"
            policy = "A further policy" if last else "The only policy"
            done = f"{policy} had passed {passed}" if made else "No policy had been tried"
            after = f", after {counted(len(drawn), 'random experiment')}" if drawn else ""
            told.append(f"{done} when the budget was spent{after}.")
        return Outcome.NOT_SUCCEEDED, " ".join(told)

    def experimented(self, rollout: Rollout) -> None:
        """Note an experiment."""
        self._made.append(rollout)
        self._unfinished.append(rollout)

    def trying(self, number: int, count: int) -> None:
        """Note a test episode."""
        self.episode = f"test episode {number + 1} of {count}: "

    def iterated(self, iteration: Iteration) -> None:
        """Note an iteration."""
        self._unfinished.clear()
        self._iterations.append(iteration)

    def stop(self, record: TrialRecord) -> TrialRecord:
        """Record how the trial ended or stopped; if it had already ended, use its recorded outcome."""
        if self._kept is not None:
            self._kept.check()
            summary, test = record.summary, self._policy_test
            if record.traceback:
                summary = replace(summary, traceback_file=self._kept.traceback(record.traceback))
            self._kept.stop(summary, episodes_csv(test, self._study.task) if test else None)
            record = replace(record, summary=self._kept.summary(summary) or summary)
        return record

    def record(self, outcome: Outcome, reason: str = "", traceback: str = "") -> TrialRecord:
        """The record of the trial so far, with how it ended."""
        method, test = self._study.method, self._policy_test
        before = self._kept.folder if self._kept else None
        remarks = diagnostics.of_trial(self._iterations, self._study)
        claim = claim_of(self._iterations) if outcome is Outcome.SUCCEEDED else None
        made = len(self._made)
        seconds = self._study.task.time_step * sum(rollout.frames for rollout in self._made)
        timed_out = "seconds" in self._study.budget.spent(made, seconds)
        summary = TrialSummary(
            outcome=outcome,
            reason=reason,
            experiments=made,
            iterations=len(self._iterations),
            max_experiments=made if timed_out else self._study.max_experiments,
            max_iterations=method.max_iterations,
            ended=time.time(),
            seconds=time.perf_counter() - self._clock + (self._kept.seconds_before if self._kept else 0.0),
            hardware_seconds=seconds,
            test_episodes=test.successes if test else "",
            lasting_episodes=test.lasting if test else "",
            holding_episodes=test.holding if test else "",
            success_rate=test.success_rate if test else nan,
            long_success_rate=test.long_success_rate if test else nan,
            long_seconds=test.long_seconds if test else nan,
            uptime=test.uptime if test else nan,
            policy=short_digest(self._iterations[-1].parameters.tobytes()) if self._iterations else "",
            test_words=test.words if test else "",
            claim=str(claim) if claim else "",
            claimed_share=claim.low if claim else nan,
            platforms=tuple(dict.fromkeys([*(before.platforms() if before else ()), platform.kind()])),
            processor=platform.processor(),
            diagnostics=tuple(sorted({remark.kind for remark in remarks})),
        )
        made_of = tuple(self._iterations), tuple(self._unfinished), test, traceback
        return TrialRecord(self._study, summary, *made_of, tuple(before.withdrawals()) if before else ())
