"""The one way to run a trial: every step kept as it happens, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

from threadpoolctl import threadpool_limits

from simbias.core import Waiting
from simbias.core import platform as machine
from simbias.core.error_origin import told
from simbias.core.messages import with_trace, words
from simbias.core.records import Array, Iteration, Rollout, Search
from simbias.trial.policy_test import Tries, try_policy
from simbias.trial.study import Observer, Study


class Outcome(StrEnum):
    """How a trial ended."""

    SUCCEEDED = "succeeded"
    NOT_SUCCEEDED = "not succeeded"
    WAITING = "waiting"  # for the result of an experiment; the same command goes on
    INTERRUPTED = "interrupted"  # likewise
    ERROR = "error"  # likewise, once what raised it is mended

    @property
    def final(self) -> bool:
        """Whether the trial came to its end, and would come to it again."""
        return self in (Outcome.SUCCEEDED, Outcome.NOT_SUCCEEDED)


@dataclass(frozen=True)
class TrialRecord:
    """What a trial did, up to its end or to where it stopped."""

    outcome: Outcome
    iterations: tuple[Iteration, ...]  # those that ended
    unfinished: tuple[Rollout, ...] = ()  # experiments of an iteration that did not end
    reason: str = ""  # what raised or waits: an error's type and message, or the sentence of Waiting
    traceback: str = ""
    traceback_file: str = ""  # that has it, as long as the trial has not come to its end
    max_experiments: int = 0  # that the method may make
    max_iterations: int = 0
    started: float = 0.0  # s since the epoch
    seconds: float = 0.0  # wall time, without the pictures
    hardware_seconds: float = 0.0  # that the experiments lasted on the hardware
    held_out: Tries | None = None  # what the last policy is worth, if that was asked for
    machines: tuple[str, ...] = ()  # kinds that it ran on: two if it went on elsewhere
    processor: str = ""  # model of the last one's
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # files by name

    @property
    def experiments(self) -> int:
        """Hardware experiments that were made."""
        before = self.iterations[-1].total_experiments if self.iterations else 0
        return before + len(self.unfinished)

    @property
    def experiments_until_success(self) -> float:
        """Experiments that the trial counts: without success all that it may make; nan if it did not end."""
        return self._until_success(self.experiments, self.max_experiments)

    @property
    def iterations_until_success(self) -> float:
        """Likewise, iterations."""
        return self._until_success(len(self.iterations), self.max_iterations)

    def _until_success(self, made: int, most: int) -> float:
        """A count, censored where the trial did not succeed."""
        if not self.outcome.final:
            return float("nan")
        return float(made if self.outcome is Outcome.SUCCEEDED else max(made, most))


@dataclass(frozen=True, eq=False)
class RecordedTrial:
    """A trial that a store holds."""

    run_id: str
    study: Study  # built from the run's config, without a store
    iterations: tuple[Iteration, ...]  # those that have ended


class Recorder:
    """Keeps a trial while it runs. This one keeps nothing."""

    pictures: Sequence[str] = ()  # those that are drawn at the trial's end
    machines: Sequence[str] = ()  # kinds that the trial was run on before

    def recalling(self, study: Study) -> Study:
        """The study, its experiments and searches kept, and those that were made before recalled."""
        return study

    def iterated(self, iteration: Iteration) -> None:
        """Keep an iteration."""

    def explained(self, traceback: str) -> str:
        """Keep where in the code a trial ended with an error; the file that has it, if one has."""
        return ""

    def ended(self, record: TrialRecord) -> None:
        """Keep how the trial ended, or why it stopped."""

    def illustrated(self, pictures: Mapping[str, bytes]) -> None:
        """Keep pictures of the trial, files by name."""


def run_trial(
    study: Study, recorder: Recorder | None = None, observer: Observer | None = None
) -> TrialRecord:
    """Run a trial, or go on with it where it stopped.

    Experiments and searches that the recorder knows are not made again; what follows them is as if nothing
    had come between, on one kind of machine. What a component raises is told in the record. Linear algebra
    runs on one thread, as more would change the last bits of a factorisation.

    Raises
    ------
    KeyboardInterrupt
        When interrupted; what was done is kept.
    """
    recorder = recorder or Recorder()
    run = _Run(study, recorder, observer or Observer())
    with threadpool_limits(1, user_api="blas"):
        try:
            recalling = recorder.recalling(study)
            for iteration in recalling.run(run):
                run.iterated(iteration)
            run.try_last_policy(recalling)
            succeeded = bool(run.iterations) and run.iterations[-1].succeeded
            record = run.record(Outcome.SUCCEEDED if succeeded else Outcome.NOT_SUCCEEDED)
        except Waiting as reason:
            record = run.record(Outcome.WAITING, words(reason))
        except (KeyboardInterrupt, GeneratorExit):
            recorder.ended(run.record(Outcome.INTERRUPTED))
            raise
        except BaseException as error:  # also SystemExit, and by what other libraries end their tasks
            record = run.record(Outcome.ERROR, told(error), with_trace(error))
            record = replace(record, traceback_file=recorder.explained(record.traceback))
        recorder.ended(record)
    return record


class _Run(Observer):
    """A trial that runs: what it has done so far."""

    def __init__(self, study: Study, recorder: Recorder, observer: Observer) -> None:
        self._method, self._time_step = study.method, study.task.time_step
        self._recorder = recorder
        self._observer = observer
        self._started, self._clock = time.time(), time.perf_counter()
        self._unfinished: list[Rollout] = []
        self.iterations: list[Iteration] = []
        self._held_out: Tries | None = None
        self.searching = observer.searching  # type: ignore[method-assign]  # called thousands of times

    def searched(self, search: Search) -> None:
        """Pass it on."""
        self._observer.searched(search)

    def experimenting(self, theta: Array, start: Array) -> None:
        """Pass it on."""
        self._observer.experimenting(theta, start)

    def experimented(self, rollout: Rollout) -> None:
        """Note an experiment, and pass it on."""
        self._unfinished.append(rollout)
        self._observer.experimented(rollout)

    def iterated(self, iteration: Iteration) -> None:
        """Keep an iteration, then pass it on."""
        self._unfinished.clear()
        self.iterations.append(iteration)
        self._recorder.iterated(iteration)
        self._observer.iterated(iteration)

    @property
    def _made(self) -> list[Rollout]:
        """All experiments."""
        return [*(rollout for each in self.iterations for rollout in each.experiments), *self._unfinished]

    def try_last_policy(self, study: Study) -> None:
        """Try the last policy from held-out starts, if the study asks for that."""
        if self.iterations:
            theta = self.iterations[-1].parameters
            self._held_out = try_policy(study, theta, study.held_out, self._observer.trying)

    def record(self, outcome: Outcome, reason: str = "", trace: str = "") -> TrialRecord:
        """What has been done, and how it ended."""
        return TrialRecord(
            outcome=outcome,
            iterations=tuple(self.iterations),
            unfinished=tuple(self._unfinished),
            reason=reason,
            traceback=trace,
            max_experiments=self._method.max_experiments,
            max_iterations=self._method.max_iterations,
            machines=tuple(dict.fromkeys([*self._recorder.machines, machine.kind()])),
            processor=machine.processor(),
            started=self._started,
            seconds=time.perf_counter() - self._clock,
            hardware_seconds=self._time_step * sum(rollout.frames for rollout in self._made),
            held_out=self._held_out,
        )
