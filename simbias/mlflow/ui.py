"""MLflow's pages of a store in a browser."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import webbrowser

from simbias.core.errors import ConfigError
from simbias.core.interruption import Interruption
from simbias.mlflow.store import is_server

HOST, PORT = "127.0.0.1", 5000
SPARING = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # a fifth of the memory, and sooner up
SECONDS = 120.0  # until MLflow's server is up
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")  # of Linux; without one, a browser would take the terminal


def show(uri: str, page: str, port: int | None = None) -> None:
    """Open a page of a store, which is served until Ctrl-C if it is no server itself.

    Raises
    ------
    ConfigError
        If MLflow's server does not start.
    """
    if is_server(uri):
        _open(f"{uri.rstrip('/')}/{page}")
        return
    port = port or _free_port()
    command = [sys.executable, "-m", "mlflow", "ui", "--workers", "1", "--host", HOST, "--port", str(port)]
    command += ["--backend-store-uri", uri]
    environment, nowhere = SPARING | os.environ, subprocess.DEVNULL
    with Interruption(), subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere) as server:
        try:
            _wait_for(server, port)
            _open(f"http://{HOST}:{port}/{page}")
            server.wait()
        finally:
            server.terminate()


def _free_port() -> int:
    """MLflow's own port, or another one if that is taken."""
    with socket.socket() as probe:
        taken = probe.connect_ex((HOST, PORT)) == 0
    if not taken:
        return PORT
    with socket.create_server((HOST, 0)) as free:
        return int(free.getsockname()[1])


def _wait_for(server: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the server answers."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        time.sleep(0.1)
    raise ConfigError("ui", f"MLflow's server does not start at port {port}; --port takes another")


def _open(address: str) -> None:
    """Show a page in the browser, if there is one, and its address."""
    print(f"{address}  (Ctrl-C ends)", flush=True)
    if sys.platform != "linux" or any(map(os.environ.get, DISPLAYS)):
        webbrowser.open(address)
