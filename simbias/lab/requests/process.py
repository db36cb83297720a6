"""A program in any language: an order on its standard input, a trajectory on its standard output, as JSON."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task, Waiting
from simbias.core.messages import brief, quote, words
from simbias.core.ranges import Seconds
from simbias.core.records import Array, Rollout
from simbias.lab.requests.order import Order
from simbias.lab.requests.trajectory import Recording, frame

STOP_SECONDS = 3.0  # that a program has to end after it was told to
SAID = 200  # characters of what a program says on its standard error
FIELDS = ("states", "inputs", "times", "failure")


class Process(Hardware):
    """Starts a program for each experiment: the bridge to ROS 2, or to a lab's own software.

    It gets an order (`simbias.lab.requests.order`) and answers with one JSON object:

        {"states": [[...], ...], "inputs": [[...], ...], "times": [...], "failure": null}

    States are rows of what was measured, inputs what was commanded from each row on, or one row fewer.
    Without times in s, a row is a frame. A failure that no criterion of the task recognises has a name; rows
    after one that a criterion recognises are cut off. Or it answers {"waiting": "what to do meanwhile"}: the
    same order comes again with the next start. What else it prints on its standard error is passed on.

    Parameters
    ----------
    command
        The program and its arguments, as a shell splits them; no shell runs.
    timeout
        Seconds after which the program is ended, first by SIGTERM.
    """

    sets_start = False  # as far as anybody knows

    def __init__(self, task: Task, command: str, timeout: Seconds = 60.0) -> None:
        self._task = task
        self._command = shlex.split(command)
        self._timeout = timeout
        self._running: subprocess.Popen[str] | None = None
        if not self._command:
            raise ValueError("command is empty")

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The trajectory that the program answers with.

        Raises
        ------
        HardwareError
            If it cannot be started, fails, takes too long, or its answer is none.
        Waiting
            If it says so.
        """
        order = Order(self._task, policy, theta, start, int(rng.integers(2**62)))
        return self._rollout(self._answer(order.text()))

    def stop(self) -> None:
        """End the program."""
        if self._running is not None:
            _end(self._running)

    def _answer(self, order: str) -> Any:
        """What the program says."""
        try:
            process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                start_new_session=True,
            )
        except OSError as error:
            raise HardwareError(f"{self._name}: cannot be started ({words(error)})") from error
        self._running = process
        try:
            out, said = process.communicate(order, self._timeout)
        except subprocess.TimeoutExpired:
            _end(process)
            raise HardwareError(
                f"{self._name}: expected an answer within {self._timeout:g} s (hardware.timeout), got none"
            ) from None
        except BaseException:  # interrupted
            _end(process)
            raise
        finally:
            self._running = None
        if process.returncode:
            last = brief(said[-SAID:]) or "it says nothing"
            raise HardwareError(f"{self._name}: expected exit status 0, got {process.returncode}: {last}")
        sys.stderr.write(said)
        try:
            return json.loads(out)
        except ValueError as error:
            raise HardwareError(
                f"{self._name}: expected one JSON object, got {quote(out)} ({words(error)})"
            ) from error

    def _rollout(self, answer: Any) -> Rollout:
        """The rollout in an answer."""
        if isinstance(answer, Mapping) and isinstance(answer.get("waiting"), str):
            raise Waiting(answer["waiting"])
        if not isinstance(answer, Mapping) or not {"states", "inputs"} <= answer.keys():
            raise HardwareError(
                f"{self._name}: expected an object with states and inputs, got {quote(answer)}"
            )
        unknown = sorted(set(map(str, answer)) - set(FIELDS))
        if unknown:
            raise HardwareError(f"{self._name}: {', '.join(unknown)}: expected {', '.join(FIELDS)} alone")
        states = self._table(answer, "states", len(self._task.states))
        inputs = self._table(answer, "inputs", len(self._task.inputs))
        if len(inputs) == len(states) - 1:
            inputs = np.concatenate([inputs, np.zeros((1, inputs.shape[1]))])  # nothing acted any more
        times = self._task.time_step * np.arange(len(states), dtype=np.float64)
        if (given := answer.get("times")) is not None:
            rows = [[time] for time in given] if isinstance(given, list) else given
            times = self._table({"times": rows}, "times", 1)[:, 0]
        if not len(states) == len(inputs) == len(times):
            raise HardwareError(
                f"{self._name}: expected as many rows, got {len(states)} states, {len(inputs)} inputs and "
                f"{len(times)} times"
            )
        failure = answer.get("failure")
        if failure is not None and not isinstance(failure, str):
            raise HardwareError(f"{self._name}: failure: expected a name or null, got {quote(failure)}")
        return frame(Recording(times, states, inputs, failure), self._task, self._name)

    def _table(self, answer: Mapping[str, Any], name: str, columns: int) -> Array:
        """Rows of finite numbers."""
        try:
            table = np.array(answer[name], dtype=np.float64)
        except (TypeError, ValueError):
            raise HardwareError(
                f"{self._name}: {name}: expected rows of {columns} numbers, got {quote(answer[name])}"
            ) from None
        if table.ndim != 2 or table.shape[1] != columns or not len(table):
            raise HardwareError(
                f"{self._name}: {name}: expected rows of {columns} numbers, got the shape {table.shape}"
            )
        broken = np.flatnonzero(~np.isfinite(table).all(axis=1))
        if len(broken):
            raise HardwareError(
                f"{self._name}: {name}: row {broken[0] + 1}: expected finite numbers, "
                f"got {quote(table[broken[0]].tolist())}"
            )
        return table

    @property
    def _name(self) -> str:
        """The program."""
        return f"{type(self).__name__} {shlex.join(self._command)}"


def _end(process: subprocess.Popen[str]) -> None:
    """End a program, on POSIX with those that it started: first kindly."""
    for name in ("SIGTERM", "SIGKILL"):
        with suppress(ProcessLookupError, PermissionError):
            if os.name == "posix":
                os.killpg(process.pid, getattr(signal, name))
            else:
                process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(STOP_SECONDS)
            return
