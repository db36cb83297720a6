"""A program in any language: it reads a request as JSON on standard input, and prints the answer as JSON."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any, final

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.messages import brief, counted, quote, words
from simbias.core.ranges import Seconds
from simbias.core.records import Array, Rollout
from simbias.lab.requests.measurements import Measurements, frame
from simbias.lab.requests.program import END_SECONDS, MOST_OUTPUT, Program, alone, note
from simbias.lab.requests.request import ExperimentRequest

SAID = 200  # characters of a program's standard error in an error
FIELDS = ("states", "inputs", "times", "failure")


@final
class Process(Hardware):
    """Starts a program for each experiment: the bridge to ROS 2, or to a lab's own software.

    The program gets a request (`simbias.lab.requests.request`) and answers with one JSON object:

        {"states": [[...], ...], "inputs": [[...], ...], "times": [...], "failure": null}

    States are rows of measurements. Inputs are the commands from each row on, with as many rows or one fewer.
    Without times in s, a row is a frame. A failure not detected by the task's criteria has a name; rows after
    a failure by a criterion are cut off. Alternatively, it answers {"waiting": "what to do meanwhile"}: the
    next run of simbias then makes the same request. Its standard error is passed on.

    When simbias ends, is killed or interrupted, or the timeout expires, the program gets SIGTERM, and SIGKILL
    a second later (`simbias.lab.requests.supervisor`).

    Parameters
    ----------
    command
        The program and its arguments, split as in a shell, but without running a shell.
    timeout
        Seconds in addition to an experiment's own duration, after which the program is terminated.
    exclusive
        Whether an experiment waits, for at most the same time, until no other process runs the same command
        on this machine. A simulator may run several times at once; a robot may not.
    """

    sets_start = False  # not known to set it
    concurrent = True  # runs of a command wait for each other, and a supervisor ends them
    not_hashed = ("timeout", "exclusive")

    def __init__(self, task: Task, command: str, timeout: Seconds = 60.0, exclusive: bool = True) -> None:
        self._task = task
        self._command = shlex.split(command)
        self._timeout = task.horizon * task.time_step + timeout
        self._exclusive = exclusive
        self._program: Program | None = None
        if not self._command:
            raise ValueError("command is empty")

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The trajectory in the program's answer.

        Raises
        ------
        HardwareError
            If the program cannot be started, fails, takes too long, or does not answer with a trajectory.
        Waiting
            If the program answers so.
        """
        request = ExperimentRequest(self._task, policy, theta, start, int(rng.integers(2**62)))
        self._program = None
        try:
            return self._rollout(self._answer(request.text()), request)
        except HardwareError as error:
            said = self._program.out.text if self._program else ""
            problem = f"{type(self).__name__} {shlex.join(self._command)}: {error}"
            raise HardwareError(problem, said or None) from error

    def stop(self) -> None:
        """Terminate the program."""
        if self._program is not None:
            self._program.end()

    def _answer(self, text: str) -> Any:
        """Run the program; return the JSON that it prints."""
        held = alone(self._command, self._timeout + END_SECONDS) if self._exclusive else nullcontext()
        with held as lock:
            self._program = program = Program(self._command, text, [lock.fileno()] if lock else [])
            try:
                if lock:
                    note(lock, program.pid)
                status = program.wait(self._timeout)
            finally:  # also if this is interrupted
                program.end()
        out, said = program.out, program.err.text
        if out.too_long or program.err.too_long:
            raise HardwareError(f"expected at most {MOST_OUTPUT >> 20} MB of output, got more")
        if status is None:
            limit = f"{self._timeout:g} s (its own duration and hardware.timeout)"
            raise HardwareError(f"expected an answer within {limit}, got none")
        if status:
            last = brief(said[-SAID:]) or "it printed no message"
            raise HardwareError(f"expected exit status 0, got {status}: {last}")
        sys.stderr.write(said)
        try:
            return json.loads(out.text)
        except (ValueError, RecursionError) as error:
            raise HardwareError(
                f"expected one JSON object, got {quote(out.text)} ({words(error)})"
            ) from error

    def _rollout(self, answer: Any, request: ExperimentRequest) -> Rollout:
        if isinstance(answer, Mapping) and isinstance(answer.get("waiting"), str):
            raise Waiting(answer["waiting"])
        if not isinstance(answer, Mapping) or not {"states", "inputs"} <= answer.keys():
            raise HardwareError(f"expected an object with states and inputs, got {quote(answer)}")
        unknown = sorted(set(map(str, answer)) - set(FIELDS))
        if unknown:
            raise HardwareError(f"{', '.join(unknown)}: expected only {', '.join(FIELDS)}")
        states = _rows(answer["states"], "states", len(self._task.states))
        inputs = _rows(answer["inputs"], "inputs", len(self._task.inputs))
        if len(inputs) == len(states) - 1:
            inputs = np.concatenate([inputs, np.zeros((1, inputs.shape[1]))])  # no input acts at the end
        times = self._task.time_step * np.arange(len(states), dtype=np.float64)
        if (given := answer.get("times")) is not None:
            rows = [[time] for time in given] if isinstance(given, list) else given
            times = _rows(rows, "times", 1)[:, 0]
        if not len(states):
            raise HardwareError("states: expected at least one row, got none")
        if not len(states) == len(inputs) == len(times):
            raise HardwareError(
                f"expected equally many rows of each, got {len(states)} states, {len(inputs)} inputs and "
                f"{len(times)} times"
            )
        failure = answer.get("failure")
        if failure is not None and not isinstance(failure, str):
            raise HardwareError(f"failure: expected a name or null, got {quote(failure)}")
        return frame(Measurements(times, states, inputs, failure or None), request, "the answer")


def _rows(given: Any, name: str, columns: int) -> Array:
    """Rows (r, columns) of finite numbers."""
    if not isinstance(given, list):
        raise HardwareError(f"{name}: expected rows of {columns} numbers, got {quote(given)}")
    for place, row in enumerate(given, 1):
        if not (isinstance(row, list) and len(row) == columns and all(map(_is_finite, row))):
            expected = counted(columns, "finite number")
            raise HardwareError(f"{name}: row {place}: expected {expected}, got {quote(row)}")
    return np.array(given, np.float64).reshape(-1, columns)


def _is_finite(value: Any) -> bool:
    """Whether a value of an answer is a number that fits a float."""
    return type(value) in (int, float) and abs(value) <= sys.float_info.max
