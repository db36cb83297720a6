"""Every engine gives every result once, whatever becomes of its workers."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import psutil
import pytest
from sweeping import FOUR_CELLS, run, trial_by_trial, write_sweep

from simbias.config import ConfigError, compose
from simbias.config.build import engine
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky
from simbias.engine.rounds import RoundBrokenError, until_done
from simbias.engine.sequential import Sequential
from simbias.interfaces import Engine, WorkerLostError
from simbias.tracking.store import connect

needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs dask")
ENGINES = [
    Sequential(),
    Loky(n_jobs=1),
    Loky(n_jobs=2),
    pytest.param(Dask(n_jobs=2, patience=1.0), marks=needs_dask),
]
WORKERS = [Loky(n_jobs=2), pytest.param(Dask(n_jobs=2, patience=1.0), marks=needs_dask)]

Task = tuple[int, float, str]  # a number, seconds, what becomes of its worker


def work(task: Task) -> tuple[int, int]:
    """Twice the number, and who found it."""
    number, seconds, fate = task
    time.sleep(seconds)
    if fate == "always dies" or (fate and fate != "lives" and not Path(fate).exists()):
        if fate != "always dies":
            Path(fate).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * number, os.getpid()


@pytest.mark.parametrize("chosen", ENGINES, ids=lambda e: type(e).__name__)
def test_every_task_once(chosen: Engine) -> None:
    found = list(chosen.run(work, [(number, 0.01, "") for number in range(7)]))
    assert sorted((index, result[0]) for index, result in found) == [(i, 2 * i) for i in range(7)]  # type: ignore[index]
    assert list(chosen.run(work, [])) == []


@pytest.mark.parametrize("chosen", WORKERS, ids=lambda e: type(e).__name__)
def test_a_worker_that_dies_once_loses_nothing(chosen: Engine, tmp_path: Path) -> None:
    tasks: list[Task] = [(number, 0.1, "") for number in range(8)]
    tasks[3] = (3, 0.1, str(tmp_path / "died"))
    found = list(chosen.run(work, tasks))
    assert sorted((index, result[0]) for index, result in found) == [(i, 2 * i) for i in range(8)]  # type: ignore[index]
    assert (tmp_path / "died").exists()
    assert os.getpid() not in {result[1] for _, result in found}  # type: ignore[index]


def dask_gives_up_at_once() -> Any:
    """Without this Dask lets a task kill four workers before it gives it up, which takes its time."""
    try:
        import dask
    except ImportError:
        return nullcontext()
    return dask.config.set({"distributed.scheduler.allowed-failures": 0})


@pytest.mark.parametrize("chosen", WORKERS, ids=lambda e: type(e).__name__)
def test_a_task_that_kills_its_workers_is_told_from_the_others(chosen: Engine) -> None:
    tasks: list[Task] = [(number, 0.1, "") for number in range(6)]
    tasks[1] = (1, 0.0, "always dies")
    with dask_gives_up_at_once():
        found = dict(chosen.run(work, tasks))
    assert isinstance(found.pop(1), WorkerLostError)
    assert {index: result[0] for index, result in found.items()} == {i: 2 * i for i in (0, 2, 3, 4, 5)}  # type: ignore[index]


@pytest.mark.parametrize("chosen", WORKERS, ids=lambda e: type(e).__name__)
def test_closing_stops_the_workers(chosen: Engine) -> None:
    results = chosen.run(work, [(number, 0.0 if number == 0 else 30.0, "") for number in range(3)])
    _, (_, pid) = next(results)  # type: ignore[misc]
    start = time.monotonic()
    results.close()  # type: ignore[attr-defined]
    assert time.monotonic() - start < 15
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


def test_no_innocent_is_blamed() -> None:
    """Tasks that were under way when another killed the workers run on, that one ends alone."""
    rounds = []

    def breaking(calls: Any, alone: bool) -> Any:
        batch = [index for index, _ in calls]
        rounds.append((batch, alone))
        if 2 in batch:
            raise RoundBrokenError("gone")
        for index in batch:
            yield index, index

    found = dict(until_done(breaking, ["a", "b", "c"]))
    assert isinstance(found.pop(2), WorkerLostError)
    assert found == {0: 0, 1: 1}
    assert rounds[:2] == [([0, 1, 2], False)] * 2
    assert all(alone and len(batch) == 1 for batch, alone in rounds[2:])


@needs_dask
def test_dask_sweep_with_a_killed_worker(tmp_path: Path) -> None:
    """Two worker processes of a real local cluster, one killed in the middle: as without engine and kill."""
    folders = [tmp_path / name for name in ("dask", "sequential")]
    write_sweep(tmp_path, "mine", FOUR_CELLS)
    connect(f"sqlite:///{tmp_path}/mlflow.db", "another")
    for folder in folders:
        folder.mkdir()
        shutil.copy(tmp_path / "mlflow.db", folder)
    command = ["--config-dir", str(tmp_path / "conf"), "+sweep=mine", "sweep.trials=3"]
    killed: list[int] = []
    killer = threading.Thread(target=kill_a_dask_worker, args=(os.getpid(), killed), daemon=True)
    killer.start()
    status, out, err = run(*command, "engine=dask", "engine.patience=3", folder=folders[0])
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


@needs_dask
def test_dask_at_an_address(tmp_path: Path) -> None:
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        chosen = engine(compose(["engine=dask", f"engine.address={cluster.scheduler_address}"]))
        assert isinstance(chosen, Dask)
        found = dict(chosen.run(work, [(1, 0.0, ""), (2, 0.0, "")]))
        assert {index: result[0] for index, result in found.items()} == {0: 2, 1: 4}  # type: ignore[index]
        assert os.getpid() not in {result[1] for result in found.values()}  # type: ignore[index]


@needs_dask
def test_no_scheduler_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbias.engine.dask.CONNECT_SECONDS", 1)
    with pytest.raises(ConfigError, match=r"engine\.address: tcp://127\.0\.0\.1:9: no scheduler answers"):
        list(Dask(address="tcp://127.0.0.1:9").run(work, [(1, 0.0, "")]))


def test_dask_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(ConfigError, match=r"pip install 'simbias\[dask\]'"):
        list(Dask().run(work, [(1, 0.0, "")]))


@pytest.mark.parametrize("name", ["loky", "sequential", "dask"])
def test_engines_are_built_from_their_yaml(name: str) -> None:
    chosen = engine(compose([f"engine={name}"]))
    assert type(chosen).__module__ == f"simbias.engine.{name}"
