"""Start-up time and memory: `python sweeps/benchmarks/footprint.py` prints a table.

The command line is started several times; a sweep runs while its processes' resident memory is sampled. A
worker of joblib's has no other children, and its memory is its own but for the pages of shared libraries.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil

ROUNDS = 7
SAMPLING_SECONDS = 0.05
COMMAND = [sys.executable, "-m", "simbias"]
SWEEP = ["+sweep=table2", "sweep.trials=1", "bias=sparse_gp", "optimizer.max_evaluations=300"]


def start_seconds(arguments: Sequence[str]) -> list[float]:
    """Wall times of the command line."""
    times = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        subprocess.run([*COMMAND, *arguments], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - began)
    return times


def peak_memory() -> tuple[float, dict[int, float]]:
    """Peak resident memory in MiB of a sweep's parent, and of each of its workers."""
    parent, workers = 0.0, dict[int, float]()
    with tempfile.TemporaryDirectory() as folder:
        store = f"tracking.uri=sqlite:///{Path(folder, 'mlflow.db')}"
        process = psutil.Popen([*COMMAND, *SWEEP, store], stdout=subprocess.DEVNULL)
        while process.poll() is None:
            try:
                parent = max(parent, process.memory_info().rss / 2**20)
                for child in process.children():
                    if any("popen_loky" in word for word in child.cmdline()):
                        memory = child.memory_info().rss / 2**20
                        workers[child.pid] = max(memory, workers.get(child.pid, 0.0))
            except psutil.NoSuchProcess:
                pass
            time.sleep(SAMPLING_SECONDS)
    return parent, workers


def main() -> None:
    """Measure, and print the table."""
    print("| what | median (least-greatest) |\n| :-- | --: |")
    for arguments in (["--help"], ["--version"], ["--cfg", "job"]):
        low, middle, high = np.quantile(start_seconds(arguments), [0, 0.5, 1])
        print(
            f"| `python -m simbias {' '.join(arguments)}` | {middle:.2f} s ({low:.2f}-{high:.2f}) |",
            flush=True,
        )
    parent, workers = peak_memory()
    print(f"| peak memory of a sweep's parent | {parent:.0f} MiB |")
    for memory in workers.values():
        print(f"| peak memory of a worker | {memory:.0f} MiB |")


if __name__ == "__main__":
    main()
