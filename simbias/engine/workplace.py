"""What a process has on the disk for a while, for itself and its workers, and what dead ones left."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

SEMAPHORES = Path("/dev/shm")  # where Linux shows them
PREFIX = "simbias-workers-"  # then the number of the process
LOCK = "lock"


@cache
def workplace() -> Path:
    """A folder of this process alone, which goes with it.

    The process holds a lock on a file in it: while the lock is held, the process lives. Its number alone
    would not tell, as it may live in a container whose processes we do not see.
    """
    return Path(_folder().name)


@cache
def _folder() -> TemporaryDirectory:
    """The folder, which is removed at the process' end."""
    folder = TemporaryDirectory(prefix=f"{PREFIX}{os.getpid()}-")
    atexit.register(folder.cleanup)  # else Python warns of what it removes itself
    _lock(os.open(Path(folder.name, LOCK), os.O_CREAT | os.O_WRONLY))  # open as long as the process lives
    return folder


def temporary_folder() -> TemporaryDirectory:
    """A folder for a while, within that of this process: what a kill leaves of it, a later start removes."""
    return TemporaryDirectory(dir=workplace())


def tidy() -> None:
    """Remove what dead processes of ours left: folders, and semaphores that loky named by their numbers.

    A process that ends is tidied by itself, one that is killed by loky's own watcher, unless that dies too.
    """
    if sys.platform == "win32":  # which removes semaphores itself
        return
    for folder in Path(gettempdir()).glob(f"{PREFIX}*-*"):
        with suppress(OSError, ValueError):  # gone meanwhile, another user's, or not of our making
            pid = int(folder.name.split("-")[2])
            if folder.is_symlink() or folder.stat().st_uid != os.getuid() or _alive(pid):
                continue
            with (folder / LOCK).open("r+") as file:
                if not _lock(file.fileno()):
                    continue
                for semaphore in SEMAPHORES.glob(f"sem.loky-{pid}-*"):
                    if semaphore.stat().st_uid == os.getuid():
                        semaphore.unlink()
                shutil.rmtree(folder)


def _lock(file: int) -> bool:
    """Take the lock of an open file, until it is closed; False if another has it."""
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _alive(pid: int) -> bool:
    """Whether there is a process of this number, be it another one by now."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
