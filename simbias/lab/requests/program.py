"""Programs that drive a robot: they end with this process, run one at a time, and have bounded output."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from simbias.core import HardwareError
from simbias.lab.requests import supervisor

MOST_OUTPUT = 2**26  # bytes of standard output, and of standard error
END_SECONDS = supervisor.GRACE + 0.5  # for a supervisor to end its program
LOCKS = "/tmp"  # regardless of TMPDIR, which may differ between jobs, services and users
POLL_SECONDS = 0.05  # between two attempts to lock


class Program:
    """One run of a program, under a supervisor that ends it when this process is gone."""

    def __init__(self, command: Sequence[str], text: str, keep: Sequence[int] = ()) -> None:
        self._supervisor = subprocess.Popen(
            [sys.executable, "-I", "-S", supervisor.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in a terminal is for this process
            pass_fds=keep,
        )
        self.pid = self._supervisor.pid
        pipe, out, err = self._supervisor.stdin, self._supervisor.stdout, self._supervisor.stderr
        assert pipe is not None
        assert out is not None
        assert err is not None
        self._pipe = pipe  # the program may run as long as it is open
        self.out, self.err = _Output(out, self._close), _Output(err, self._close)
        line = json.dumps({"command": list(command), "text": text, "keep": list(keep)})
        with suppress(OSError):  # it has ended; see its exit status
            self._pipe.write(f"{line}\n".encode())
            self._pipe.flush()

    def wait(self, seconds: float) -> int | None:
        """The exit status once the program has closed its output and ended; None if not within `seconds`."""
        until = time.monotonic() + seconds
        for output in (self.out, self.err):
            output.join(max(0.0, until - time.monotonic()))
        try:
            return self._supervisor.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            return None

    def end(self) -> None:
        """End the program if it is still running; on POSIX, with the processes that it started."""
        self._close()
        try:
            self._supervisor.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self._supervisor.kill()

    def _close(self) -> None:
        """Make the supervisor end the program."""
        with suppress(OSError, ValueError):
            self._pipe.close()


class _Output(threading.Thread):
    """Reads the output of a program, which is ended if it prints more than MOST_OUTPUT."""

    def __init__(self, stream: IO[bytes], end: Callable[[], None]) -> None:
        super().__init__(daemon=True)
        self._stream, self._end = stream, end
        self._chunks: list[bytes] = []
        self.too_long = False
        self.start()

    def run(self) -> None:
        """Read to the end, even beyond the maximum, so that nothing blocks on a full pipe."""
        size = 0
        with suppress(OSError, ValueError), self._stream:
            while chunk := os.read(self._stream.fileno(), 65536):
                size += len(chunk)
                if size <= MOST_OUTPUT:
                    self._chunks.append(chunk)
                elif not self.too_long:
                    self.too_long = True
                    self._end()

    @property
    def text(self) -> str:
        """The output so far."""
        return b"".join(self._chunks).decode(errors="replace")


@contextmanager
def alone(command: Sequence[str], seconds: float) -> Iterator[IO[str] | None]:
    """A file locked by one run of a command until all that inherited it have ended; None on Windows.

    Raises
    ------
    HardwareError
        If another run of the same command holds it for longer than `seconds`.
    """
    if sys.platform == "win32":
        yield None
        return
    import fcntl

    name = hashlib.sha256(json.dumps(list(command)).encode()).hexdigest()[:16]
    with _shared_file(Path(LOCKS, f"simbias_robot_{name}.lock")) as file:
        until, waits = time.monotonic() + seconds, False
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                file.seek(0)
                process = file.read().strip() or "unknown"
                holder = f"it is still running for another experiment (process {process})"
            if time.monotonic() >= until:
                raise HardwareError(
                    f"{holder}, after {seconds:g} s; end it, or set hardware.exclusive=false for a simulator"
                )
            if not waits:
                logging.getLogger(__name__).warning("simbias: %s; waiting for its end", holder)
            waits = True
            time.sleep(POLL_SECONDS)
        yield file


def _shared_file(path: Path) -> IO[str]:
    """A file that every user of this machine may open, in any environment."""
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        os.fchmod(handle, 0o666)  # regardless of the umask
    except FileExistsError:
        handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    return os.fdopen(handle, "r+")


def note(file: IO[str], pid: int) -> None:
    """Note in a locked file which process to end."""
    file.seek(0)
    file.truncate()
    file.write(f"{pid}\n")
    file.flush()
