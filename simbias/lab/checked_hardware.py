"""Experiments on a hardware, whatever the hardware does: raise, return what is no rollout, or never end."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextvars import copy_context
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.messages import with_type
from simbias.core.records import Array, Rollout
from simbias.lab.checks import check_rollout
from simbias.lab.safety import NO_LIMITS, Guarded, Safety

STOP_SECONDS = 5.0  # that `Hardware.stop` has, and then again the experiment that it stops
MESSAGE_LENGTH = 250  # of what a hardware raises


def ask(theta: Array, start: Array) -> bool:
    """Ask a person whether the hardware may be used; where nobody is, it may not."""
    try:
        answer = input("Run this experiment, and those that follow, on the hardware? [y/N] ")
    except (EOFError, OSError):
        return False
    return answer.strip().lower() in ("y", "yes")


@dataclass(frozen=True)
class Conditions:
    """Under which experiments are made.

    Parameters
    ----------
    timeout
        Seconds of wall time that an experiment may take. With a limit, it runs in a thread of its own; where
        it takes longer, the hardware is asked to stop, and what it still does is of no interest. Code that
        never returns to Python's interpreter cannot be stopped so.
    safety
        Limits at which an experiment is aborted; it has failed then.
    confirm
        Whether a person is asked before the first experiment.
    ask
        Asks whether theta (p,) may be run from a start (n,).
    """

    timeout: float | None = None
    safety: Safety = NO_LIMITS
    confirm: bool = False
    ask: Callable[[Array, Array], bool] = ask


UNCONDITIONED = Conditions()


class Conducted(Hardware):
    """A hardware whose every experiment ends in a rollout that keeps the contract, or in one line.

    Parameters
    ----------
    hardware
        Whatever it does.
    task
        Whose rollouts it should return.
    conditions
        Of all experiments.

    Raises
    ------
    ValueError
        If a limit names nothing of the task.
    """

    def __init__(self, hardware: Hardware, task: Task, conditions: Conditions) -> None:
        self._hardware = hardware
        self._task = task
        self._timeout = conditions.timeout
        self._bounds = conditions.safety.bounds(task) if conditions.safety.limits else None
        self._ask = conditions.ask if conditions.confirm else None
        self.sets_start = hardware.sets_start

    def wrap(self, hardware: Hardware, task: Task) -> Conducted:
        """The same of another hardware, on a task whose experiments may take longer or shorter."""
        other = copy(self)
        other._hardware, other._task, other.sets_start = hardware, task, hardware.sets_start
        if self._timeout is not None:
            other._timeout = self._timeout * task.horizon / self._task.horizon
        return other

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment.

        Raises
        ------
        HardwareError
            If it could not be carried out, whatever the hardware raised; did not end in time; or its rollout
            is not what the contract asks for.
        Waiting
            If its result is not there yet.
        """
        if self._ask is not None:
            if not self._ask(theta, start):
                raise Waiting("the experiment was not confirmed (hardware.confirm=true)")
            self._ask = None
        returned = self._guarded(policy, theta, start, rng)
        try:
            return check_rollout(returned, self._hardware, self._task)
        except Exception as error:  # also what a rollout of its own class raises
            problem = str(error)
            if not isinstance(error, HardwareError):
                problem = f"{self._name}.run: expected a Rollout, got {with_type(error, MESSAGE_LENGTH)}"
            raise HardwareError(f"{problem}{self.refuse(returned, theta, start, problem)}") from error

    def _guarded(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Any:
        """What the hardware returns, not yet checked; an aborted experiment as far as it was recorded.

        It gets copies: what it writes into them is its own.
        """
        theta, start = theta.copy(), start.copy()
        if self._bounds is None:
            return self._returned(lambda: _in_one_process(self._hardware.run, policy, theta, start, rng))
        guarded = Guarded(policy, self._task, self._bounds)
        try:
            return self._returned(lambda: _in_one_process(self._hardware.run, guarded, theta, start, rng))
        except Exception:
            if guarded.last is None or not guarded.last.failure:
                raise
            _Call(self._hardware.stop).ended(STOP_SECONDS)
            return guarded.last.record()

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep what breaks the contract; where it is, in words that follow those of the error."""
        return ""

    def _returned(self, experiment: Callable[[], Any]) -> Any:
        """What the hardware returns, not yet checked."""
        try:
            return experiment() if self._timeout is None else self._in_time(experiment, self._timeout)
        except (HardwareError, Waiting, KeyboardInterrupt):
            raise
        except BaseException as error:  # also SystemExit, and by what other libraries end their tasks
            got = with_type(error, MESSAGE_LENGTH)
            raise HardwareError(f"{self._name}.run: expected a Rollout, got {got}") from error

    def _in_time(self, experiment: Callable[[], Any], seconds: float) -> Any:
        """What an experiment returns within so many seconds."""
        call = _Call(experiment)
        try:
            in_time = call.ended(seconds)
        except BaseException:  # interrupted
            self._stop(call)
            raise
        if not in_time:
            raise HardwareError(
                f"{self._name}.run: expected an end within {seconds:g} s (experiment_timeout), got none; "
                f"{self._name}.stop {self._stop(call)}"
            )
        return call.result()

    def _stop(self, experiment: _Call) -> str:
        """Ask the hardware to stop; how that went."""
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
        """The component."""
        return type(self._hardware).__name__


def _in_one_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns or raises; a process that it forks and that comes back from it ends here.

    It would go on with the trial, too, and write what its parent writes.
    """
    process = os.getpid()
    try:
        return function(*arguments)
    finally:
        if os.getpid() != process:
            os._exit(1)


class _Call:
    """A call in a thread, which ends with the process at the latest, and what came of it."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self._function = function
        self._result: Any = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=copy_context().run, args=(self._run,), daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """In the thread."""
        try:
            self._result = self._function()
        except BaseException as error:
            self._error = error

    def ended(self, seconds: float) -> bool:
        """Whether it has ended, after so many seconds or sooner."""
        self._thread.join(min(seconds, threading.TIMEOUT_MAX))
        return not self._thread.is_alive()

    def result(self) -> Any:
        """What it returned; what it raised is raised."""
        if self._error is not None:
            raise self._error
        return self._result
