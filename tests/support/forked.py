"""`python -m simbias` in a fork of a process that has imported what it needs, which takes it two seconds.

Tests start it a hundred times. In all else it is a process as any other: of its own session, with its own
folder, environment, arguments and exit status. README's commands, notebooks and studies are started from
nothing.
"""

import ast
import atexit
import gc
import importlib
import os
import resource
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

IMPORTED = ["config.build", "engine.loky", "pictures.trial.gallery", "sweep.running"]
IMPORTED += ["sweep.worker", "terminal.sweep", "terminal.trial", "testing.rehearsal", "mlflow.tracking"]
IMPORTED += ["mlflow.sweep", "sweep.results"]
LIBRARIES = ["hydra", "joblib", "nlopt", "scipy.optimize", "scipy.signal", "scipy.stats"]
LIBRARIES += ["mlflow", "mlflow.store.artifact.local_artifact_repo", "mlflow.store.tracking.sqlalchemy_store"]


class Forked:
    """A running `python -u -m simbias`, as a `subprocess.Popen` of it would be; its output is text."""

    def __init__(
        self,
        arguments: tuple[str, ...],
        folder: Path,
        environment: dict[str, str],
        largest_file: int | None = None,  # bytes
    ) -> None:
        (out, out_end), (err, err_end) = os.pipe(), os.pipe()
        self._zygote = socket.socket(socket.AF_UNIX)
        self._zygote.connect(_address())
        socket.send_fds(self._zygote, [b"!"], [out_end, err_end])
        self._zygote.sendall(repr((arguments, str(folder), environment, largest_file)).encode())
        self._zygote.shutdown(socket.SHUT_WR)
        os.close(out_end)
        os.close(err_end)
        self.stdout, self.stderr = (open(end, encoding="utf-8") for end in (out, err))  # noqa: SIM115
        self.returncode: int | None = None
        self.pid = self._number()

    def send_signal(self, number: int) -> None:
        """Unless it has ended."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """For good."""
        self.send_signal(signal.SIGKILL)

    def wait(self) -> int:
        """Its exit status, once it has ended; the signal that killed it is negative."""
        if self.returncode is None:
            self.returncode = self._number()
            self._zygote.close()
        return self.returncode

    def communicate(self) -> tuple[str, str]:
        """All that it still says, until it has ended."""
        with ThreadPoolExecutor(2) as readers:
            out, err = readers.map(_read, (self.stdout, self.stderr))
        self.wait()
        return out, err

    def _number(self) -> int:
        """What the zygote says next."""
        return int.from_bytes(self._zygote.recv(4, socket.MSG_WAITALL), "big", signed=True)


def _read(stream) -> str:
    """Everything, to the end."""
    with stream:
        return stream.read()


@cache
def _address() -> str:
    """Where a zygote listens, which is started for it and ends with this process."""
    folder = tempfile.TemporaryDirectory()
    address = f"{folder.name}/zygote"
    tests = Path(__file__).parents[1]
    folders = (tests.parent, tests, tests / "support", tests.parent / "notebooks" / "examples")
    path = os.pathsep.join(map(str, folders))
    listening = subprocess.Popen(
        [sys.executable, __file__, address], env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE
    )
    atexit.register(folder.cleanup)
    atexit.register(listening.kill)
    assert listening.stdout.readline() == b"ready\n"
    return address


def serve(address: str) -> None:
    """Import, then fork a process for each request, and a second one that waits for it."""
    for module in [f"simbias.{name}" for name in IMPORTED] + LIBRARIES:
        importlib.import_module(module)
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    parent = os.getppid()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # those that wait are not waited for
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(address)
        server.listen(100)
        server.settimeout(1.0)
        print("ready", flush=True)
        while True:
            try:
                connection, _ = server.accept()
            except TimeoutError:
                if os.getppid() != parent:  # has been killed
                    return
                continue
            if os.fork() == 0:
                break
            connection.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    _, ends, _, _ = socket.recv_fds(connection, 1, 2)
    with connection.makefile("rb") as request:
        arguments, folder, environment, largest_file = ast.literal_eval(request.read().decode())
    if (pid := os.fork()) == 0:
        connection.close()
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        _become(arguments, folder, environment, ends)
    for end in ends:
        os.close(end)
    connection.sendall(pid.to_bytes(4, "big", signed=True))
    _, status = os.waitpid(pid, 0)
    connection.sendall(os.waitstatus_to_exitcode(status).to_bytes(4, "big", signed=True))
    os._exit(0)


def _become(arguments: tuple[str, ...], folder: str, environment: dict[str, str], ends: list[int]) -> None:
    """Go on as `python -u -m simbias`."""
    os.setsid()
    for standard, end in enumerate(ends, start=1):
        os.dup2(end, standard)
        os.close(end)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    sys.path[0] = folder
    sys.argv = ["-m", *arguments]
    runpy._run_module_as_main("simbias")  # type: ignore[attr-defined]


if __name__ == "__main__":
    serve(sys.argv[1])
