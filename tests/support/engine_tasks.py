"""What engines' workers do in tests, in a module that they import at once."""

import importlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from simbias.core.files import find
from simbias.engine.contract import WorkplaceError

Task = tuple[int, float, str]  # a number, seconds, what becomes of its worker
HANDED_OVER = 8_000_000  # numbers


def call(task: tuple[Callable, Any]) -> Any:
    """What a function gives for its argument."""
    function, argument = task
    return function(argument)


def work(task: Task) -> tuple[int, int]:
    """Twice the number, and the process that did it."""
    number, seconds, fate = task
    time.sleep(seconds)
    if fate == "always dies":
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number, os.getpid()


def hand_over_a_view(task: dict[str, int]) -> Any:
    """A result that a plain pickle refuses, as parts of trials are."""
    return MappingProxyType(task)


def hand_over(task: tuple[float, str]) -> np.ndarray:
    """A result of 64 MB, whose worker is killed so many seconds after it is computed, once."""
    seconds, fate = task
    if not Path(fate).exists():
        Path(fate).touch()
        threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return np.zeros(HANDED_OVER)


def examine(task: tuple[float, Any]) -> tuple[float, str, set[int]]:
    """A number whose last bits matter, the task in words, and how many threads libraries use here."""
    x, _ = task
    np.ones((9, 9)) @ np.ones((9, 9))
    threads = {library["num_threads"] for library in threadpool_info()}
    return sum(math.sin(k * x) / k for k in range(1, 200)), repr(task), threads


def begin(task: tuple[str, float]) -> int:
    """Say so, and go on for so long; the process that did it."""
    file, seconds = task
    Path(file).touch()
    time.sleep(seconds)
    return os.getpid()


def see(folder: str) -> tuple[str, str]:
    """What a module `mine` and a file beside the folder of configs hold here."""
    try:
        value = importlib.import_module("mine").VALUE
    except ImportError:
        value = ""
    file = Path(find("mine.txt", [folder]))
    return value, file.read_text() if file.exists() else ""


def begin_elsewhere(refusing: list[str]) -> str:
    """The worker that does it, if it is none of these."""
    from distributed import get_worker

    if (worker := get_worker().address) in refusing:
        raise WorkplaceError("no room")
    time.sleep(0.05)
    return worker
