"""Experiments that end in a checked rollout or a one-line error, even if the hardware misbehaves."""

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
from simbias.core.error_origin import is_own
from simbias.core.errors import ConfigError
from simbias.core.interruption import deferred
from simbias.core.messages import with_type
from simbias.core.records import Array, Rollout
from simbias.lab.checks import check_rollout
from simbias.lab.safety import NO_LIMITS, Safety, SafetyLimitedPolicy, within_limits
from simbias.lab.targets import WithTargets, beside

STOP_SECONDS = 5.0  # for `Hardware.stop`, and again for the stopped experiment to end
INTERRUPT_SECONDS = 1.5  # for both after Ctrl-C
BEGIN_SECONDS = 0.2  # for a thread to start
MESSAGE_LENGTH = 250  # characters of an error raised by hardware


def ask(policy: Policy, theta: Array, start: Array, horizon: int) -> bool:
    """Ask a person whether the hardware may be used; without a terminal it may not."""
    try:
        answer = input("Run this experiment, and those that follow, on the hardware? [y/N] ")
    except (EOFError, OSError):
        return False
    return answer.strip().lower() in ("y", "yes")


@dataclass(frozen=True)
class ExperimentConditions:
    """The conditions under which experiments are run.

    Parameters
    ----------
    timeout
        Wall time in s that an experiment may take. With a limit, it runs in its own thread; if it takes
        longer, it is stopped, and its result ignored. Code that never returns to the Python interpreter
        cannot be stopped this way.
    safety
        Limits at which an experiment is aborted and counts as failed.
    confirm
        Whether a person must confirm before the first experiment.
    ask
        Function that asks whether a policy with theta (p,) may run from a start (n,) for a number of frames.
    """

    timeout: float | None = None
    safety: Safety = NO_LIMITS
    confirm: bool = False
    ask: Callable[[Policy, Array, Array, int], bool] = ask


DEFAULT_CONDITIONS = ExperimentConditions()


MakeExperiment = Callable[[np.random.Generator], Rollout]


def place_of(rng: np.random.Generator) -> tuple[int, ...]:
    """The place of an experiment in its trial: the spawn key of its generator, () if it was not spawned."""
    return tuple(getattr(rng.bit_generator.seed_seq, "spawn_key", ()))


class ExperimentRecord(ABC):
    """Keeps experiments, and replays those that it has kept."""

    @abstractmethod
    def experiment(self, theta: Array, rng: np.random.Generator, make: MakeExperiment) -> Rollout:
        """The next experiment, with theta (p,): replayed, or run and kept before it is used."""

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep an invalid result of the hardware; return its place as the end of a message."""
        return ""


@final
class CheckedHardware(Hardware):
    """Hardware whose experiments end in a rollout that keeps the contract, or in a one-line error.

    Parameters
    ----------
    hardware
        May raise, hang, or return anything.
    task
        Defines the shapes, the horizon and the limits of rollouts. The hardware gets a start without targets,
        and a policy that knows them.
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
        self._unconfirmed = [conditions.ask] if conditions.confirm else []  # shared with copies
        self._record = record
        self._returned: Any = None  # the hardware's result in the latest experiment
        self.sets_start = hardware.sets_start

    def with_hardware(self, hardware: Hardware, task: Task) -> CheckedHardware:
        """A copy for a task with another horizon, with the same conditions and record; the timeout scales."""
        other = copy(self)
        other._hardware, other._task, other.sets_start = hardware, task.without_targets, hardware.sets_start
        if self._timeout is not None:
            other._timeout = self._timeout * task.horizon / self._task.horizon
        return other

    def whole(self) -> AbstractContextManager[None]:
        """Defer interruptions, once the hardware has returned, until its result is kept and counted."""
        self._returned = None
        return deferred(lambda: self._returned is not None)

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """Run one experiment with theta (p,), or replay it.

        Raises
        ------
        HardwareError
            If it could not be carried out (any hardware error), did not end in time, or its rollout breaks
            the contract.
        ConfigError
            If a file that a person provided for it is bad input.
        Waiting
            If its result is not available yet.
        """
        make = partial(self._make, policy, theta, start)
        return make(rng) if self._record is None else self._record.experiment(theta, rng, make)

    def _make(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        for allows in self._unconfirmed:
            if not allows(policy, theta, start, self._task.horizon):
                raise Waiting("the experiment was not confirmed (hardware.confirm=true)")
        self._unconfirmed.clear()
        start, targets = np.split(start, [len(self._task.states)])
        own, name = is_own(policy), type(policy).__name__
        policy = WithTargets(policy, targets, self._targets) if len(targets) else policy
        if self._bounds is not None:
            policy = SafetyLimitedPolicy(policy, self._task, self._bounds)
        elif own:  # it may break its contract
            policy = within_limits(policy, self._task, name)
        returned = self._run(policy, theta.copy(), start.copy(), rng)  # the hardware may overwrite its copies
        return beside(replace(self._checked(returned, theta, start), parameters=theta), targets)

    def _checked(self, returned: Any, theta: Array, start: Array) -> Rollout:
        try:
            begins = start if self.sets_start else None
            return check_rollout(returned, self._name, self._task, self._bounds, begins)
        except Exception as error:  # including errors of a custom rollout class
            problem = str(error)
            if not isinstance(error, HardwareError):
                problem = f"{self._name}: expected a Rollout, got {with_type(error, MESSAGE_LENGTH)}"
            where = self._record.refuse(returned, theta, start, problem) if self._record else ""
            raise HardwareError(f"{problem}{where}") from error

    def _run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Any:
        """The hardware's unchecked result; for an aborted experiment, the rollout up to its last frame."""

        def experiment() -> Any:
            process = os.getpid()
            try:
                self._returned = self._hardware.run(policy, theta, start, rng)
                return self._returned
            finally:
                if os.getpid() != process:  # a process forked by the hardware ends here
                    os._exit(1)

        try:
            return experiment() if self._timeout is None else self._in_time(experiment)
        except KeyboardInterrupt:
            if self._timeout is None:  # otherwise it has been stopped already
                _Call(self._hardware.stop).ended(INTERRUPT_SECONDS)
            raise
        except BaseException as error:  # also SystemExit, and what other libraries raise to cancel tasks
            if isinstance(policy, SafetyLimitedPolicy) and (aborted := policy.aborted):
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
        """The result of an experiment within its timeout, run in its own thread."""
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
        """Stop an experiment; return the outcome in words."""
        stop = _Call(self._hardware.stop)
        if not stop.ended(STOP_SECONDS):
            return f"did not end within {STOP_SECONDS:g} s either"
        try:
            stop.result()
        except BaseException as error:
            return f"raised {with_type(error, MESSAGE_LENGTH)}"
        ended = experiment.ended(STOP_SECONDS)
        return f"was called, {'and the experiment ended' if ended else 'but the experiment still runs'}"

    @property
    def _name(self) -> str:
        """The name of the hardware's method in errors."""
        return f"{type(self._hardware).__name__}.run"


class _Call:
    """A call in a daemon thread; `ended` starts it."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function
        self._result: Any = None
        self._error: BaseException | None = None
        self._started = False
        self._begun = threading.Event()
        self._ended = threading.Event()  # in Python 3.11, Ctrl-C makes `Thread.join` forget the thread
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
        self._started = True  # a call interrupted before its start never starts
        if self._begun.wait(BEGIN_SECONDS):
            thread = ctypes.c_ulong(self._thread.ident or 0)
            ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(KeyboardInterrupt))

    def result(self) -> Any:
        """The call's result; raises its error."""
        if self._error is not None:
            raise self._error
        return self._result
