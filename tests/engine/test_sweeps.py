"""A whole sweep on a cluster of which a worker is killed."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import psutil
import pytest
from sweeping import FOUR_CELLS, run, trial_by_trial, write_sweep

pytestmark = pytest.mark.slow

pytest.importorskip("distributed")


def test_dask_sweep_with_a_killed_worker(tmp_path: Path) -> None:
    """Two worker processes of a real local cluster, one killed in the middle: as without engine and kill."""
    folders = [tmp_path / name for name in ("dask", "sequential")]
    write_sweep(tmp_path, "mine", FOUR_CELLS)
    for folder in folders:
        folder.mkdir()
    command = ["--config-dir", str(tmp_path / "conf"), "+sweep=mine", "sweep.trials=3", "tracking=folders"]
    killed: list[int] = []
    killer = threading.Thread(target=kill_a_dask_worker, args=(os.getpid(), killed), daemon=True)
    killer.start()
    status, out, err = run(*command, "engine=dask", folder=folders[0])
    assert (status, err) == (0, ""), out + err
    assert len(killed) == 1
    assert run(*command, "engine=sequential", folder=folders[1])[0] == 0
    assert trial_by_trial(folders[0]) == trial_by_trial(folders[1])


def kill_a_dask_worker(root: int, killed: list[int]) -> None:
    """Wait until two workers compute, then kill one."""
    for _ in range(600):
        time.sleep(0.1)
        busy = []
        for process in psutil.Process(root).children(recursive=True):
            try:
                if "multiprocessing.spawn" in " ".join(process.cmdline()) and process.cpu_times().user > 1.0:
                    busy.append(process)
            except psutil.Error:
                continue
        if len(busy) == 2:
            time.sleep(0.5)
            busy[0].kill()
            killed.append(busy[0].pid)
            return
