"""The folder of a process and its workers on the disk, and what dead processes left there."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

PREFIX = "simbias-workers-"  # then the number of the process
LOCK = "lock"


@cache
def workplace() -> Path:
    """A folder of this process alone, which goes with it.

    The process holds a lock on a file in it: while the lock is held, the process lives. Its number alone
    would not tell, as it may live in a container whose processes we do not see.
    """
    tidy()  # what dead processes left
    folder = TemporaryDirectory(prefix=f"{PREFIX}{os.getpid()}-")
    atexit.register(folder.cleanup)  # else Python warns of what it removes itself
    made = Path(folder.name, f"new {LOCK}")
    _lock(os.open(made, os.O_CREAT | os.O_WRONLY))  # open as long as the process lives
    made.rename(made.with_name(LOCK))  # locked when others see it
    return Path(folder.name)


def temporary_folder() -> TemporaryDirectory:
    """A folder for a while, within that of this process: what a kill leaves of it, the next run removes."""
    return TemporaryDirectory(dir=workplace())


def tidy() -> None:
    """Remove the folders of dead processes of ours: a process that ends removes its own."""
    for folder in Path(gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # gone meanwhile, another user's, or without a lock
            with (folder / LOCK).open("r+") as file:
                dead = _lock(file.fileno())
            if dead:
                shutil.rmtree(folder)


def _lock(file: int) -> bool:
    """Take the lock of an open file, until it is closed; False if another has it, or there are no locks."""
    if sys.platform == "win32":
        return False
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
