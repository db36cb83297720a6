"""Opening MLflow's pages of a store in a browser."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import webbrowser

from simbias.core.errors import ConfigError
from simbias.core.interruption import Interruption
from simbias.core.messages import redact
from simbias.mlflow.store import address, is_server

HOST, PORT = "127.0.0.1", 5000
SPARING = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # a fifth of the memory, and a faster start
SECONDS = 120.0  # until MLflow's server is up
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")  # on Linux; without one, a browser would use the terminal


def show(uri: str, page: str, port: int | None = None) -> None:
    """Open a page of a store; if the store is not a server, serve it until Ctrl-C.

    ConfigError if the port is taken, or MLflow's server does not start.
    """
    if is_server(uri):
        _open(f"{uri.rstrip('/')}/{page}", uri)
        return
    port = _free_port(port)
    command = [sys.executable, "-m", "mlflow", "ui", "--workers", "1", "--host", HOST, "--port", str(port)]
    # In the environment, since all users can see command lines, and the address may have a password.
    store, nowhere = {"MLFLOW_BACKEND_STORE_URI": address(uri)}, subprocess.DEVNULL
    environment = SPARING | os.environ | store
    with Interruption(), subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere) as server:
        try:
            _wait_for(server, port)
            _open(f"http://{HOST}:{port}/{page}")
            server.wait()
        finally:
            server.terminate()


def _free_port(asked: int | None) -> int:
    """The requested port; by default MLflow's own, or another if that is taken."""
    port = PORT if asked is None else asked
    if not 0 < port < 2**16:
        raise ConfigError("--port", f"expected 1 to 65535, got {port}")
    if not _answers(port):
        return port
    if asked is not None:
        raise ConfigError("--port", f"{port} is taken; without --port, a free one is used")
    with socket.create_server((HOST, 0)) as free:
        return int(free.getsockname()[1])


def _wait_for(server: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the server answers."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end and server.poll() is None:
        if _answers(port):
            return
        time.sleep(0.1)
    raise ConfigError("ui", f"MLflow's server did not start at port {port}; choose another with --port")


def _answers(port: int) -> bool:
    """Whether something on this machine listens at a port."""
    with socket.socket() as probe:
        return probe.connect_ex((HOST, port)) == 0


def _open(address: str, uri: str = "") -> None:
    """Open a page in the browser, if there is one, and print its address without the store's login."""
    print(f"{redact(address, uri)}  (Ctrl-C stops a local server)", flush=True)
    if sys.platform != "linux" or any(map(os.environ.get, DISPLAYS)):
        webbrowser.open(address)
