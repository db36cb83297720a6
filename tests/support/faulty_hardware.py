"""A hardware that does what no hardware should, until it is mended."""

import asyncio
import ctypes
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task
from simbias.core.records import Array, Rollout
from simbias.robots.bongoboard.pymunk import PymunkBongoboard

CONF = {  # files of a folder of configs
    "hardware/faulty.yaml": "_target_: faulty_hardware.Faulty\nfault: none\n",
    "components.yaml": "allow: [faulty_hardware]\n",
}
MENDED = "mended"  # a file of the working folder: the hardware works


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise ValueError


def _raise(error: BaseException) -> NoReturn:
    raise error


def _recurse(rollout: Rollout) -> Any:
    return _recurse(rollout)


def _hole(rollout: Rollout) -> Array:
    states = rollout.states.copy()
    states[3, 0] = np.nan
    return states


RAISED: dict[str, Callable[[Rollout], Any]] = {  # what they raise or how they end
    "zero division": lambda rollout: 1 / 0,
    "recursion": _recurse,
    "speechless": lambda rollout: _raise(SpeechlessError()),
    "no UTF-8": lambda rollout: _raise(OSError("caf\udce9\n\x07 \x1b[31mred\x1b[0m")),
    "long": lambda rollout: _raise(RuntimeError("x" * 100_000)),
    "exit": lambda rollout: sys.exit(7),
    "cancelled": lambda rollout: _raise(asyncio.CancelledError()),
    "own words": lambda rollout: _raise(HardwareError("the battery is empty")),
}


class Unread(Rollout):
    def __getattribute__(self, name: str) -> Any:
        if name == "states":
            raise KeyError("no connection")
        return super().__getattribute__(name)


RETURNED: dict[str, Callable[[Rollout], Any]] = {
    "None": lambda rollout: None,
    "list": lambda rollout: [rollout.states.tolist(), rollout.inputs.tolist(), None],
    "dict": lambda rollout: {"states": rollout.states, "file": "run.csv"},
    "another class": lambda rollout: SimpleNamespace(states=rollout.states),
    "columns": lambda rollout: replace(rollout, states=rollout.states[:, :-1]),
    "flat": lambda rollout: replace(rollout, inputs=rollout.inputs.ravel()),
    "ragged": lambda rollout: replace(rollout, states=[[0.0] * (1 + i % 2) for i in range(rollout.frames)]),  # type: ignore[arg-type]
    "too short": lambda rollout: replace(rollout, inputs=rollout.inputs[:-2]),
    "nothing measured": lambda rollout: replace(rollout, measured=np.zeros((0, 6))),
    "another rate": lambda rollout: replace(
        rollout, states=np.repeat(rollout.states, 2, axis=0)[:-1], inputs=np.repeat(rollout.inputs, 2, axis=0)
    ),
    "ended early": lambda rollout: replace(rollout, states=rollout.states[:51], inputs=rollout.inputs[:50]),
    "NaN": lambda rollout: replace(rollout, states=_hole(rollout)),
    "absurd": lambda rollout: replace(rollout, states=np.full_like(rollout.states, -1e300)),
    "elsewhere": lambda rollout: replace(rollout, states=rollout.states + 100.0),
    "a class of its own": lambda rollout: Unread(rollout.states, rollout.inputs),
    "complex": lambda rollout: replace(rollout, states=rollout.states.astype(complex)),
    "object": lambda rollout: replace(rollout, states=rollout.states.astype(object)),
    "text": lambda rollout: replace(rollout, inputs=np.full((rollout.frames, 1), "1.0")),
    "masked": lambda rollout: replace(
        rollout, states=np.ma.masked_equal(rollout.states, rollout.states[2, 1])
    ),
    "masked row": lambda rollout: replace(rollout, inputs=[np.ma.masked_all(1), *rollout.inputs[1:]]),
    "frame": lambda rollout: replace(rollout, failed_at="late"),  # type: ignore[arg-type]
    "wrong frame": lambda rollout: replace(rollout, failed_at=3, failure="distance"),
    "failure": lambda rollout: replace(rollout, failed_at=rollout.frames, failure=3),  # type: ignore[arg-type]
    "no frame of failure": lambda rollout: replace(rollout, failure="distance"),
    "sensed": lambda rollout: replace(rollout, sensed="yes"),  # type: ignore[arg-type]
}

CONVERTED: dict[str, Callable[[Rollout], Any]] = {  # without loss
    "float32": lambda rollout: replace(rollout, inputs=rollout.inputs.astype(np.float32).astype(np.float32)),
    "lists": lambda rollout: replace(
        rollout,
        states=rollout.states.tolist(),  # type: ignore[arg-type]
        inputs=rollout.inputs.tolist(),  # type: ignore[arg-type]
    ),
    "Fortran order": lambda rollout: replace(rollout, states=np.asfortranarray(rollout.states)),
    "NumPy truth": lambda rollout: replace(rollout, sensed=np.bool_(False)),  # type: ignore[arg-type]
    "its own cost": lambda rollout: replace(rollout, cost={}, parameters=None),  # type: ignore[arg-type]
}


def _hang(rollout: Rollout) -> Rollout:
    time.sleep(3600.0)
    return rollout


def _fork(rollout: Rollout, child: Callable[[Rollout], Any]) -> Any:
    return rollout if os.fork() else child(rollout)


def _leave(rollout: Rollout, kind: Callable) -> Rollout:
    kind(target=_hang, args=(rollout,)).start()
    return rollout


LEFT: dict[str, Callable[[Rollout], Any]] = {  # what goes on beside the trial, or tries to
    "fork": lambda rollout: _fork(rollout, lambda rollout: rollout),
    "fork that raises": lambda rollout: _fork(rollout, lambda rollout: 1 / 0),
    "fork that hangs": lambda rollout: _fork(rollout, _hang),
    "process": lambda rollout: _leave(rollout, multiprocessing.get_context("fork").Process),
    "thread": lambda rollout: _leave(rollout, threading.Thread),
}


def _kill(rollout: Rollout) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


DEADLY: dict[str, Callable[[Rollout], Any]] = {  # for the process
    "_exit": lambda rollout: os._exit(7),
    "SIGSEGV": lambda rollout: ctypes.string_at(0),
    "SIGKILL": _kill,
    "SIGKILL beside a child": lambda rollout: _kill(_fork(rollout, _hang)),
}


def _hoard(rollout: Rollout) -> NoReturn:
    """Ask for memory until there is none; here there is none sooner than it would hurt."""
    hoard, (_, most) = [], resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + 2**28, most))
    try:
        while True:
            hoard.append(np.ones(2**21))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


FAULTS = (
    RAISED
    | RETURNED
    | CONVERTED
    | LEFT
    | DEADLY
    | {"hangs": _hang, "30 GB": _hoard, "none": lambda rollout: rollout}
)


class Faulty(Hardware):
    """The simulated robot: all its experiments but the first meet a fault, in whatever process."""

    concurrent = True  # its stop() moves nothing

    def __init__(self, task: Task, fault: str = "none") -> None:
        self._robot = PymunkBongoboard(task)  # type: ignore[arg-type]
        self._fault = fault

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        rollout = self._robot.run(policy, theta, start, rng)
        first = Path(f"first of {self._fault}")
        if Path(MENDED).exists() or not first.exists():
            first.touch()
            return rollout
        return FAULTS[self._fault](rollout)

    def stop(self) -> None:
        Path("stopped").touch()
