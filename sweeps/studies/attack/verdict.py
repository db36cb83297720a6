"""A case of the attack: what it does to simbias, and how simbias took it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from simbias.__main__ import main
from simbias.core.messages import brief
from simbias.engine import workplace

STOP_SECONDS = 10.0  # that a trial or sweep has before it is interrupted: nobody waits for a long one
START_SECONDS = 90.0  # that it has until it says what it runs: compiling may come before
GRACE_SECONDS = 60.0  # that it then has to end
LONGEST_LINE = 1000  # of an error: a line with a key, a problem, and a command that goes on
HIT = "HIT"  # a file in the folder of a case, that only its harm would write
BEGUN = r"seed \d+, trial|\d+ cells? x"  # what is printed when a trial or a sweep begins


class Verdict(StrEnum):
    """How simbias took a case; all but the first three are finds."""

    REFUSED = "refused in one line"
    RAN = "ran"
    STOPPED = "ran until interrupted"
    LINES = "other lines"
    TRACEBACK = "traceback"
    HANG = "hang"
    CRASH = "crash"
    WRONG = "wrong result"

    @property
    def find(self) -> bool:
        """Whether it is something to mend."""
        return self not in (Verdict.REFUSED, Verdict.RAN, Verdict.STOPPED)


@dataclass(frozen=True)
class Result:
    """What came of a case."""

    surface: str
    case: str
    verdict: Verdict
    status: int | None  # None of a hang
    seconds: float
    said: str  # the last line


def judge(status: int | None, out: str, err: str) -> Verdict:
    """What an exit status and what was printed amount to; 130 of what was interrupted."""
    if status is None:
        return Verdict.HANG
    if "Traceback (most recent call last)" in out + err:
        return Verdict.TRACEBACK
    if status == -signal.SIGINT:  # as Python ends where an interrupt comes while it is ending: a shell's 130
        status = 130
    if status < 0 or status not in (0, 1, 2, 3, 130):
        return Verdict.CRASH
    lines = [line for line in err.splitlines() if not line.startswith("Compiling the simulation")]
    if status == 2 and lines and lines[0].startswith("usage: "):
        return Verdict.REFUSED
    own = [line for line in lines if line.startswith(("simbias: ", "Resume with:"))]
    if len(own) < len(lines) or any(len(line) > LONGEST_LINE for line in own):
        return Verdict.LINES
    if any(not character.isprintable() for line in own for character in line):
        return Verdict.LINES
    if status == 130:
        return Verdict.STOPPED
    return Verdict.REFUSED if status == 2 or (status == 1 and own) else Verdict.RAN


def attempt(
    surface: str,
    case: str,
    arguments: Sequence[str],
    prepare: Callable[[], object] = lambda: None,
    template: Path | None = None,
    inspect: Callable[[Path], bool] = lambda folder: True,
    forked: bool = True,
    seconds: float = STOP_SECONDS,
    tolerated: str = "(?!)",
    key: str = "",
) -> Result:
    """Run simbias with these arguments in a process and a folder of its own, both gone afterwards.

    The process is a fork, so that what is imported and compiled is there, unless it needs workers. `prepare`
    runs in it first, in the folder, a copy of the template. It has so many seconds before it is interrupted,
    and may print lines that match what is tolerated. What ran is wrong if `inspect` says so; a refusal, if it
    names neither the key nor its group, or comes only once the trial runs.
    """
    with tempfile.TemporaryDirectory(prefix="attack-") as name:
        folder = Path(name, "two", "levels", "deep")  # so that ../.. is nobody else's
        if template is None:
            folder.mkdir(parents=True)
        else:
            shutil.copytree(template, folder, symlinks=True)
        began = time.monotonic()
        child = _fork(folder, arguments, prepare, forked)
        status = _status(child, folder, seconds)
        took = time.monotonic() - began
        out, err = _read(folder / "stdout"), _read(folder / "stderr")
        verdict = judge(status, out, re.sub(f"^{tolerated}.*\\n", "", err, flags=re.MULTILINE))
        if verdict is Verdict.RAN and not inspect(folder):
            verdict = Verdict.WRONG
        late = status == 1 and not err.startswith("simbias: HardwareError")
        if verdict is Verdict.REFUSED and key and (late or key.partition(".")[0] not in err):
            verdict = Verdict.WRONG
        if list(Path(name).rglob(HIT)):
            verdict = Verdict.WRONG
        lines = (err.strip() or out.strip() or " ").splitlines()
        _unlock(folder)
    return Result(surface, brief(case, 200), verdict, status, round(took, 1), brief(lines[-1], 200))


def _fork(folder: Path, arguments: Sequence[str], prepare: Callable[[], object], forked: bool) -> int:
    """The number of a process that runs simbias in the folder."""
    child = os.fork()
    if child:
        return child
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        os.environ["HOME"] = str(folder)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY, 0o600), number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        prepare()
        if not forked:
            os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
            os.execv(sys.executable, [sys.executable, "-m", "simbias", *arguments])
        workplace.workplace.cache_clear()  # which is our parent's
        status = main(list(arguments))
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 98
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        if workplace.workplace.cache_info().currsize:
            shutil.rmtree(workplace.workplace(), ignore_errors=True)
        os._exit(status)


def _status(child: int, folder: Path, seconds: float) -> int | None:
    """The exit status of a process, negative by a signal, None if it had to be killed.

    It is interrupted if it takes long, as anybody would; before it says what it runs, that is a hang.
    """
    began = time.monotonic()
    interrupted: float | None = None
    while True:
        pid, code = os.waitpid(child, os.WNOHANG)
        if pid:
            _kill(child)  # its workers, if any is left
            return os.waitstatus_to_exitcode(code)
        now = time.monotonic()
        said = re.search(BEGUN, _read(folder / "stdout"))
        if interrupted is None and said and now - began > seconds:
            interrupted = now
            os.kill(child, signal.SIGINT)
        late = now - began > START_SECONDS if interrupted is None else now - interrupted > GRACE_SECONDS
        if late and not (said and interrupted is None):
            _kill(child)
            os.waitpid(child, 0)
            return None
        time.sleep(0.02)


def _read(file: Path) -> str:
    """What was printed so far."""
    return file.read_text(errors="replace") if file.is_file() else ""


def _kill(child: int) -> None:
    """End a process and those that it started."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)


def _unlock(folder: Path) -> None:
    """Let everything in a folder be removed."""
    for path in (folder, *folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)
