"""MLflow's own server and a real browser: what tests and benchmarks of its pages have in common."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, expect, sync_playwright

from simbias.mlflow.ui import SPARING

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE = 60.0  # s
NO_ASSISTANT = "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true')"


@contextmanager
def serve(command: str, folder: Path, port: int | None = None) -> Iterator[str]:
    """Run the command that a sweep prints, and kill it at the end; yields its address."""
    port = port or free_port()
    root = f"http://127.0.0.1:{port}"
    environment = {
        **os.environ,
        **SPARING,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "MLFLOW_DISABLE_TELEMETRY": "true",
    }
    log = folder / "server.log"
    with log.open("w") as said:
        server = subprocess.Popen(
            f"{command} --port {port}",
            shell=True,
            cwd=folder,
            env=environment,
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        _wait_until_up(root, server, log)
        yield root
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


@contextmanager
def browse() -> Iterator[Browser]:
    """Chromium that can reach nothing but this machine."""
    arguments = [
        "--disable-dev-shm-usage",
        "--no-proxy-server",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    ]
    expect.set_options(timeout=1000 * PATIENCE)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


@contextmanager
def visit(browser: Browser) -> Iterator[Page]:
    """A page of a person who was never here before, but for MLflow's assistant, which is folded away."""
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    context.set_default_timeout(1000 * PATIENCE)
    context.add_init_script(NO_ASSISTANT)
    yield context.new_page()
    context.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def is_up(root: str) -> bool:
    """Whether the server answers."""
    try:
        with urllib.request.urlopen(f"{root}/health", timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def _wait_until_up(root: str, server: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + 2 * PATIENCE
    while time.monotonic() < end and server.poll() is None:
        if is_up(root):
            return
        time.sleep(0.05)
    raise AssertionError(log.read_text())
