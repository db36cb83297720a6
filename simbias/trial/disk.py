"""Atomically written files, lines that are on disk once appended, and locks."""

from __future__ import annotations

import errno
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from simbias.core.errors import ConfigError
from simbias.core.messages import with_type, words

PART = ".part"  # suffix of a file while it is written
LOCK = ".lock"  # lock file of a folder that only one process at a time may write
LOOK_SECONDS = 1.0  # that a start waits, since checking a lock holds it for a moment

Loaded = TypeVar("Loaded")


@contextmanager
def locked(path: Path, timeout: float, taken: ConfigError) -> Iterator[None]:
    """Hold a lock in a folder, created if necessary; a ConfigError if the folder cannot be written.

    `taken` is raised if another process holds the lock for `timeout` s.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path)
        lock.acquire(timeout=timeout)
    except Timeout as error:
        raise taken from error
    except FileExistsError as error:
        raise ConfigError(str(error.filename), "is no folder, or a link to a missing one") from error
    except OSError as error:
        raise ConfigError(str(path.parent), f"cannot be written ({error.strerror})") from error
    try:
        yield
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether a process holds this lock; on POSIX, its file need not be writable."""
    try:
        if sys.platform != "win32":
            import fcntl

            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        elif path.exists():
            FileLock(path).acquire(timeout=0).lock.release()
    except (BlockingIOError, Timeout):
        return True
    except OSError:  # there is none, or it cannot be opened
        pass
    return False


def require_file(path: Path) -> Path:
    """The path, if it is a file or missing; else a ConfigError, as a pipe or a device may never end."""
    if path.exists() and not path.is_file():
        raise ConfigError(str(path), "is not a regular file")
    return path


def loaded(path: Path, load: Callable[[Path], Loaded]) -> Loaded:
    """The content of a step; a ConfigError if it cannot be read."""
    try:
        return load(require_file(path))
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(str(path), f"cannot be read ({with_type(error)})") from error


def read_json(path: Path) -> dict[str, Any]:
    """A mapping from a JSON file; a ConfigError if the file is missing or holds no mapping."""
    require_file(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(str(path), f"cannot be read ({words(error)})") from error
    if not isinstance(content, dict):
        raise ConfigError(str(path), "does not hold a JSON object")
    return content


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as JSON, atomically (`write_whole`)."""
    write_whole(path, f"{json.dumps(content, indent=1, default=str)}\n".encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically; once this returns, it survives a power failure."""
    part = _part(path)
    part.touch()
    with _named(path), part.open("r+b") as file:  # space for it may be reserved already
        file.write(content)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    if os.name == "posix":  # elsewhere a folder cannot be opened
        with _named(path):
            _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk, if its file system supports that."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


@contextmanager
def room_for(path: Path, size: int) -> Iterator[None]:
    """Reserve space for a file of at most `size` bytes: an OSError comes now, not from `write_whole`."""
    part = _part(path)
    try:
        with _named(path):
            part.write_bytes(bytes(size))
        yield
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Make system errors, such as a full disk, name the folder of the file being written."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path.parent)
        raise


def _part(path: Path) -> Path:
    """The temporary file that receives a file's content until it is complete."""
    return require_file(path.with_name(f"{path.name}{PART}"))


def append_line(path: Path, line: Mapping[str, Any]) -> None:
    """Append a line of JSON to a file, on disk when this returns; a truncated last line stays separate."""
    with _named(path), require_file(path).open("a+b") as file:
        file.seek(0, os.SEEK_END)
        if file.tell():
            file.seek(-1, os.SEEK_END)
        cut_off = file.read(1) not in (b"", b"\n")
        file.write(b"\n" * cut_off + json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of JSON of a file that may be missing; a line truncated by a kill is left out.

    A ConfigError names a line that was damaged later.
    """
    text = require_file(path).read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    lines = (_parsed(line, number, path) for number, line in enumerate(text.splitlines(), 1))
    return [line for line in lines if line]


def _parsed(line: str, number: int, path: Path) -> dict[str, Any]:
    """A mapping from a line; empty if the line was truncated, and so lacks its last bracket."""
    try:
        content = json.loads(line)
    except ValueError as error:
        if line.endswith("}"):
            raise ConfigError(str(path), f"line {number} is damaged ({words(error)}). Repair it") from error
        return {}
    return content if isinstance(content, dict) else {}
