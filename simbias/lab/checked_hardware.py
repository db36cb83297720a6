"""Experiments that end in a checked rollout or in one clear line, even if the hardware misbehaves."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import copy_context
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, final

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.errors import ConfigError
from simbias.core.interruption import deferred
from simbias.core.messages import with_type
from simbias.core.records import Array, Rollout
from simbias.lab.checks import check_rollout
from simbias.lab.safety import NO_LIMITS, Safety, SafetyLimitedPolicy
from simbias.lab.targets import WithTargets, beside

STOP_SECONDS = 5.0  # that `Hardware.stop` may take, and then again the experiment that it stops
INTERRUPT_SECONDS = 1.5  # that both may take after Ctrl-C
BEGIN_SECONDS = 0.2  # that a thread may take to begin
MESSAGE_LENGTH = 250  # characters of an error that a hardware raises


def ask(policy: Policy, theta: Array, start: Array) -> bool:
    """Ask a person whether the hardware may be used; without a terminal it may not."""
    try:
        answer = input("Run this experiment, and those that follow, on the hardware? [y/N] ")
    except (EOFError, OSError):
        return False
    return answer.strip().lower() in ("y", "yes")


@dataclass(frozen=True)
class ExperimentConditions:
    """Under which conditions experiments are made.

    Parameters
    ----------
    timeout
        Seconds of wall time that an experiment may take. With a limit, it runs in a thread of its own. One
        that takes longer is stopped, and its result ignored. Code that never returns to Python's interpreter
        cannot be stopped so.
    safety
        Limits at which an experiment is aborted; it has failed then.
    confirm
        Whether a person is asked before the first experiment.
    ask
        Asks whether a policy with theta (p,) may be run from a start (n,).
    """

    timeout: float | None = None
    safety: Safety = NO_LIMITS
    confirm: bool = False
    ask: Callable[[Policy, Array, Array], bool] = ask


DEFAULT_CONDITIONS = ExperimentConditions()


MakeExperiment = Callable[[np.random.Generator], Rollout]


def place_of(rng: np.random.Generator) -> tuple[int, ...]:
    """The place of an experiment in its trial: the spawn key of its generator, () if it was not spawned."""
    return tuple(getattr(rng.bit_generator.seed_seq, "spawn_key", ()))


class ExperimentRecord(ABC):
    """Keeps experiments, and replays those that it has kept."""

    @abstractmethod
    def experiment(self, theta: Array, rng: np.random.Generator, make: MakeExperiment) -> Rollout:
        """The next experiment, with theta (p,): replayed, or made and kept before anyone uses it."""

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep what a hardware returned that is no rollout; where it is, as the end of a message."""
        return ""


@final
class CheckedHardware(Hardware):
    """A hardware whose every experiment ends in a rollout that keeps the contract, or in one line.

    Parameters
    ----------
    hardware
        May raise, hang, or return anything.
    task
        Defines the shapes, the horizon and the limits of its rollouts. The hardware is given a start without
        its targets, and a policy that knows them.
    conditions
        Timeout, safety limits and confirmation.
    record
        Replays and keeps its experiments; without one, nothing is kept.

    Raises
    ------
    ValueError
        If a safety limit names no quantity of the task.
    """

    def __init__(
        self,
        hardware: Hardware,
        task: Task,
        conditions: ExperimentConditions = DEFAULT_CONDITIONS,
        record: ExperimentRecord | None = None,
    ) -> None:
        self._hardware = hardware
        self._task, self._targets = task.without_targets, task.targets
        self._timeout = conditions.timeout
        self._bounds = conditions.safety.bounds(task.without_targets) if conditions.safety.limits else None
        self._ask = conditions.ask if conditions.confirm else None
        self._record = record
        self._returned: Any = None  # by the hardware, in the latest experiment
        self.sets_start = hardware.sets_start

    def with_hardware(self, hardware: Hardware, task: Task) -> CheckedHardware:
        """A copy for a task of another horizon, its conditions and record the same; the timeout grows too."""
        other = copy(self)
        other._hardware, other._task, other.sets_start = hardware, task.without_targets, hardware.sets_start
        if self._timeout is not None:
            other._timeout = self._timeout * task.horizon / self._task.horizon
        return other

    def whole(self) -> AbstractContextManager[None]:
        """Inside, what the hardware has returned is kept and counted before an interruption."""
        self._returned = None
        return deferred(lambda: self._returned is not None)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment with theta (p,), or its replay.

        Raises
        ------
        HardwareError
            If it could not be carried out, for any error of the hardware; did not end in time; or its rollout
            is not what the contract asks for.
        ConfigError
            If a file that a person put for it cannot be taken.
        Waiting
            If its result is not there yet.
        """
        make = partial(self._make, policy, theta, start)
        return make(rng) if self._record is None else self._record.experiment(theta, rng, make)

    def _make(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        if self._ask is not None:
            if not self._ask(policy, theta, start):
                raise Waiting("the experiment was not confirmed (hardware.confirm=true)")
            self._ask = None
        start, targets = np.split(start, [len(self._task.states)])
        policy = WithTargets(policy, targets, self._targets) if len(targets) else policy
        returned = self._run(policy, theta.copy(), start.copy(), rng)  # it may write into its copies
        return beside(replace(self._checked(returned, theta, start), parameters=theta), targets)

    def _checked(self, returned: Any, theta: Array, start: Array) -> Rollout:
        try:
            begins = start if self.sets_start else None
            return check_rollout(returned, self._name, self._task, self._bounds, begins)
        except Exception as error:  # also what a rollout of its own class raises
            problem = str(error)
            if not isinstance(error, HardwareError):
                problem = f"{self._name}: expected a Rollout, got {with_type(error, MESSAGE_LENGTH)}"
            where = self._record.refuse(returned, theta, start, problem) if self._record else ""
            raise HardwareError(f"{problem}{where}") from error

    def _run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Any:
        """The hardware's answer, not yet checked; an aborted experiment up to its last frame."""
        limited = SafetyLimitedPolicy(policy, self._task, self._bounds) if self._bounds else None

        def experiment() -> Any:
            process = os.getpid()
            try:
                self._returned = self._hardware.run(limited or policy, theta, start, rng)
                return self._returned
            finally:
                if os.getpid() != process:  # a process that the hardware forked ends here
                    os._exit(1)

        try:
            return experiment() if self._timeout is None else self._in_time(experiment)
        except KeyboardInterrupt:
            if self._timeout is None:  # else it has been stopped
                _Call(self._hardware.stop).ended(INTERRUPT_SECONDS)
            raise
        except BaseException as error:  # also SystemExit, and what other libraries cancel tasks by
            if limited and (aborted := limited.aborted):
                self._returned = aborted
                _Call(self._hardware.stop).ended(STOP_SECONDS)
                return aborted
            if isinstance(error, HardwareError) and error.returned is not None and self._record:
                where = self._record.refuse(error.returned, theta, start, str(error))
                raise HardwareError(f"{error}{where}") from error
            if isinstance(error, HardwareError | Waiting | ConfigError):
                raise
            got = with_type(error, MESSAGE_LENGTH)
            raise HardwareError(f"{self._name}: expected a Rollout, got {got}") from error

    def _in_time(self, experiment: Callable[[], Any]) -> Any:
        """The result of an experiment within its timeout, in a thread of its own."""
        assert self._timeout is not None
        call = _Call(experiment)
        try:
            in_time = call.ended(self._timeout)
        except BaseException:  # interrupted
            until = time.monotonic() + INTERRUPT_SECONDS
            call.interrupt()
            for each in (_Call(self._hardware.stop), call):
                each.ended(max(0.0, until - time.monotonic()))
            raise
        if not in_time:
            raise HardwareError(
                f"{self._name}: expected an end within {self._timeout:g} s (experiment_timeout), got none; "
                f"{type(self._hardware).__name__}.stop {self._stop(call)}"
            )
        return call.result()

    def _stop(self, experiment: _Call) -> str:
        """Stop an experiment; how that went."""
        stop = _Call(self._hardware.stop)
        if not stop.ended(STOP_SECONDS):
            return f"did not end within {STOP_SECONDS:g} s either"
        try:
            stop.result()
        except BaseException as error:
            return f"raised {with_type(error, MESSAGE_LENGTH)}"
        ended = experiment.ended(STOP_SECONDS)
        return "was called, and it ended" if ended else "was called, but it still runs"

    @property
    def _name(self) -> str:
        """The hardware's method, as errors name it."""
        return f"{type(self._hardware).__name__}.run"


class _Call:
    """A call in a thread that ends with the process at the latest; `ended` begins it."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function
        self._result: Any = None
        self._error: BaseException | None = None
        self._started = False
        self._begun = threading.Event()
        self._ended = threading.Event()  # Ctrl-C makes `Thread.join` of Python 3.11 forget the thread
        self._thread = threading.Thread(target=copy_context().run, args=(self._run,), daemon=True)

    def _run(self) -> None:
        """Keep the function's result or error."""
        try:
            self._begun.set()
            self._result = self._function()
        except BaseException as error:
            self._error = error
        finally:
            self._ended.set()

    def ended(self, seconds: float) -> bool:
        """Wait for the experiment at most `seconds`, starting it if need be; return whether it has ended."""
        if not self._started:
            self._started = True
            self._thread.start()
        return self._ended.wait(min(seconds, threading.TIMEOUT_MAX))

    def interrupt(self) -> None:
        """Raise KeyboardInterrupt in the call, so that its `finally` brings the robot to rest."""
        self._started = True  # one that was interrupted before it began does not begin
        if self._begun.wait(BEGIN_SECONDS):
            thread = ctypes.c_ulong(self._thread.ident or 0)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(KeyboardInterrupt))

    def result(self) -> Any:
        """The call's result; its error is raised."""
        if self._error is not None:
            raise self._error
        return self._result
