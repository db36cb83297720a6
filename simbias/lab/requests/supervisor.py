"""Runs a program, and ends it when the process that started this one is gone.

Standard input brings one line of JSON: {"command": [...], "text": ..., "keep": [...]}. The program gets the
text on its standard input, and inherits the file descriptors to keep. When standard input closes (as when the
parent is killed), or on SIGTERM, the program and all processes of its group get SIGTERM, and SIGKILL after
GRACE seconds. On Linux, the program is also killed if this process is killed.

It runs as a script, with only Python's standard library, so that it starts within milliseconds.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial

GRACE = 1.0  # s between SIGTERM and SIGKILL
CANNOT_START = 127  # exit status, as in a shell
PR_SET_PDEATHSIG = 1


def main() -> int:
    """Run the program; return its exit status, or 128 + n if signal n ended it."""
    _die_with_parent(signal.SIGTERM)
    line = b""
    while not line.endswith(b"\n"):  # without sys.stdin, whose lock a blocked thread holds at exit
        chunk = os.read(0, 65536)
        if not chunk:
            return CANNOT_START
        line += chunk
    told = json.loads(line)
    try:
        program = subprocess.Popen(
            told["command"],
            stdin=subprocess.PIPE,
            start_new_session=True,
            pass_fds=told["keep"],
            preexec_fn=partial(_die_with_parent, signal.SIGKILL) if sys.platform == "linux" else None,
        )
    except OSError as error:
        print(f"cannot be started ({error})", file=sys.stderr)
        return CANNOT_START
    changed = threading.Event()  # the program has ended, or must end
    signal.signal(signal.SIGTERM, lambda *_: changed.set())
    threading.Thread(target=_give, args=(program, told["text"]), daemon=True).start()
    for wait in (program.wait, lambda: os.read(0, 1)):  # standard input closes when the parent is gone
        threading.Thread(target=_then, args=(wait, changed), daemon=True).start()
    changed.wait()
    if program.returncode is None:
        _end(program)
    status = program.wait()
    return status if status >= 0 else 128 - status


def _then(wait: Callable[[], object], changed: threading.Event) -> None:
    """Set `changed` once `wait` returns."""
    wait()
    changed.set()


def _give(program: subprocess.Popen[bytes], text: str) -> None:
    """Write the text to the program, as far as it reads it."""
    assert program.stdin is not None
    with contextlib.suppress(OSError), program.stdin as pipe:
        pipe.write(text.encode())


def _end(program: subprocess.Popen[bytes]) -> None:
    """End the program and its group: first SIGTERM, then SIGKILL."""
    _signal(program, "SIGTERM")
    until = time.monotonic() + GRACE
    while _signal(program, "") and time.monotonic() < until:
        time.sleep(0.01)
    _signal(program, "SIGKILL")


def _signal(program: subprocess.Popen[bytes], name: str) -> bool:
    """Send the program's group a signal (none for ""); return whether any process is left."""
    if os.name != "posix":
        if name:
            program.terminate()
        return program.returncode is None
    try:
        os.killpg(program.pid, getattr(signal, name) if name else 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


def _die_with_parent(number: int) -> None:
    """Request a signal for the parent's death, if the system supports it (Linux)."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)


if __name__ == "__main__":
    sys.exit(main())
