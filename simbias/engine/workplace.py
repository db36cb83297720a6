"""The temporary folder of a process and its workers, and the removal of dead processes' folders."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

PREFIX = "simbias-workers-"  # followed by the process id
LOCK = "lock"


@cache
def workplace() -> Path:
    """A folder of this process alone, removed at its end.

    The process locks a file in it: as long as the lock is held, the process is alive. The process id would
    not suffice, as the process may be in a container whose processes are invisible here.
    """
    tidy()  # what dead processes left
    folder = TemporaryDirectory(prefix=f"{PREFIX}{os.getpid()}-")
    atexit.register(folder.cleanup)  # otherwise Python warns of its own removal
    made = Path(folder.name, f"new {LOCK}")
    _lock(os.open(made, os.O_CREAT | os.O_WRONLY))  # open until the process ends
    made.rename(made.with_name(LOCK))  # already locked when others see it
    return Path(folder.name)


def temporary_folder() -> TemporaryDirectory:
    """A temporary folder within this process's; after a kill, the next run removes it."""
    return TemporaryDirectory(dir=workplace())


def tidy() -> None:
    """Remove folders of this user's killed processes; others remove their own."""
    for folder in Path(gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # already gone, another user's, or without a lock
            with (folder / LOCK).open("r+") as file:
                dead = _lock(file.fileno())
            if dead:
                shutil.rmtree(folder)


def _lock(file: int) -> bool:
    """Lock an open file until it is closed; False if another process has it, or locks are unsupported."""
    if sys.platform == "win32":
        return False
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
