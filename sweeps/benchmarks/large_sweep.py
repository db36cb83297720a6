"""What a sweep costs beside its computation: `python sweeps/benchmarks/large_sweep.py FOLDER [--trials N]`.

Trials of two experiments of 20 frames, which cost next to nothing: the rest is ours and MLflow's. It writes
FOLDER/large_sweep.csv, the parent's memory and processor time as trials end, and prints how long it takes
to start the finished sweep again, and to show its pages in a browser. The store is kept in FOLDER/store;
started again, it goes on.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))  # the tests' own helpers

from mlflow_ui import PATIENCE, browse, free_port, is_up, visit
from playwright.sync_api import Page, expect

from simbias.mlflow.ui import SPARING

SHORT = [
    *("task.horizon=20", "method.max_iterations=1", "optimizer.max_evaluations=3", "bias=none"),
    "tracking.pictures=false",
]
CELLS = 2
SAMPLING_SECONDS = 5.0
ROUNDS = 5
ENDED = re.compile(r"^\[(\d+)/", re.MULTILINE)
PRINTED = re.compile(r"^Look at it:  (.*)$", re.MULTILINE)


def run(command: list[str], store: Path) -> tuple[str, pd.DataFrame]:
    """What the sweep says, and its parent's resident memory (MiB) and processor time (s) as trials end."""
    rows = []
    with (store / "said").open("w+") as said:
        began = time.monotonic()
        parent = psutil.Popen(command, cwd=store, stdout=said)
        while parent.poll() is None:
            try:
                used, memory = parent.cpu_times(), parent.memory_info().rss / 2**20
            except psutil.NoSuchProcess:
                break
            count = ENDED.findall((store / "said").read_text()[-2000:])
            rows.append((time.monotonic() - began, int(count[-1]) if count else 0, memory, used[0] + used[1]))
            time.sleep(SAMPLING_SECONDS)
        if parent.wait() != 0:
            sys.exit(f"the sweep ended with status {parent.returncode}")
        columns = ["seconds", "trials", "parent_mib", "parent_cpu_seconds"]
        return (store / "said").read_text(), pd.DataFrame(rows, columns=columns)


def start_seconds(command: list[str], store: Path) -> float:
    """How long the finished sweep takes until it begins with its trials, of which none is left."""
    began = time.monotonic()
    with subprocess.Popen(command, cwd=store, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        next(line for line in parent.stdout if "finished" in line)
        taken = time.monotonic() - began
        parent.stdout.read()
    return taken


@contextmanager
def serve(command: str, folder: Path) -> Iterator[str]:
    """Run the command that a sweep prints, and kill it at the end; yields its address."""
    port = free_port()
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


def _wait_until_up(root: str, server: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + 2 * PATIENCE
    while time.monotonic() < end and server.poll() is None:
        if is_up(root):
            return
        time.sleep(0.05)
    raise AssertionError(log.read_text())


def seconds_to_show(page: Page, address: str, name: str) -> float:
    """How long until a page of MLflow's shows a link of this name."""
    page.goto("about:blank")
    began = time.monotonic()
    page.goto(address)
    expect(page.get_by_role("link", name=name, exact=True).first).to_be_visible()
    return time.monotonic() - began


def main() -> None:
    """Run the sweep, start it again, and look at its pages."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--trials", type=int, default=10_000)
    parsed = parser.parse_args()
    store = parsed.folder / "store"
    store.mkdir(parents=True, exist_ok=True)
    repetitions = f"sweep.trials={parsed.trials // CELLS}"
    command = [sys.executable, "-u", "-m", "simbias", "+sweep=smoke", repetitions, *SHORT]

    said, table = run(command, store)
    if len(table) > 1:  # else it was finished before
        table.round(1).to_csv(parsed.folder / "large_sweep.csv", index=False)
    started = sorted(start_seconds(command, store) for _ in range(ROUNDS))
    print(f"started again in {started[ROUNDS // 2]:.2f} s ({started[0]:.2f}-{started[-1]:.2f})")

    found = PRINTED.search(said)
    assert found is not None, said[-500:]
    with serve(found[1], store) as root, browse() as browser, visit(browser) as page:
        sweep, _, _ = (store / "server.log").read_text().partition("  ")
        trials = f"{root}/#/experiments/1/runs?workflowType=machine_learning"
        for what, address, name in (
            ("the sweep's page", sweep, "experiments/mean"),
            ("the list of searches", trials, "sweep smoke"),
        ):
            shown = sorted(seconds_to_show(page, address, name) for _ in range(ROUNDS))
            print(f"{what}: {shown[ROUNDS // 2]:.2f} s ({shown[0]:.2f}-{shown[-1]:.2f})")


if __name__ == "__main__":
    main()
