"""Every engine gives every result once, whatever becomes of its workers."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from engine_tasks import Task, call, examine, hand_over, hand_over_a_view, work
from processes import runs, wait_for
from threadpoolctl import threadpool_limits

from simbias.engine.contract import Engine, WorkerLostError
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky
from simbias.engine.sequential import Sequential

pytestmark = pytest.mark.slow

HAS_DASK = importlib.util.find_spec("distributed") is not None
NAMES = ["loky", *(["dask"] if HAS_DASK else [])]
WORKERS = [Loky(n_jobs=2), *([Dask(n_jobs=2)] if HAS_DASK else [])]
NUMBERS = 40


def name_of(subject: Any) -> str:
    return type(subject).__name__


class Counted(Sequence):
    """Tasks that count how many were taken out."""

    def __init__(self, tasks: list[Any]) -> None:
        self.tasks, self.starts = tasks, 0

    def __len__(self) -> int:
        return len(self.tasks)

    def __getitem__(self, index: Any) -> Any:
        task = self.tasks[index]
        self.starts += 1
        return task


@pytest.mark.parametrize("subject", [Sequential(), Loky(n_jobs=1), *WORKERS], ids=name_of)
def test_each_task_has_its_result_once(subject: Engine, tmp_path: Path) -> None:
    """The one that it has here: Dask looks into arguments for keys and calls, which is none of its business.

    Workers that die once, at work or while they hand over half a result, lose nothing. Dask has no more
    tasks at a time than two for each worker.
    """
    things = [{"a": ("x", [1, {"b": (None, len)}])}, (max, 1, 2), "_run_alone"]
    others = [(examine, (0.1 * k, thing)) for k, thing in enumerate(things)]
    others.append((hand_over_a_view, {"a": 1}))
    listed = [*others, *((work, (number, 0.0, "")) for number in range(NUMBERS))]
    fates = [tmp_path / name for name in ("at work", "half")] if subject in WORKERS else []
    if fates:
        listed[10] = (work, (10 - len(others), 0.1, str(fates[0])))
        listed.append((hand_over, (0.2, str(fates[1]))))
    tasks, results = Counted(listed), []
    with threadpool_limits(1):
        for result in subject.run(call, tasks):
            results.append(result)
            assert not isinstance(subject, Dask) or tasks.starts - len(results) < 3 * 2
        found = dict(results)
        assert [found.pop(index) for index in range(len(others))] == list(map(call, others))
    assert len(results) == len(tasks)
    done = [found.pop(index) for index in range(len(others), len(others) + NUMBERS)]
    assert [number for number, _ in done] == [2 * number for number in range(NUMBERS)]
    assert list(subject.run(work, [])) == []
    if fates:
        assert np.size(found.pop(len(tasks) - 1)) == 20_000_000
        assert all(fate.exists() for fate in fates)
        assert os.getpid() not in {pid for _, pid in done}
    assert found == {}


@pytest.mark.parametrize("subject", WORKERS, ids=name_of)
def test_only_the_task_that_kills_its_workers_is_blamed(subject: Engine) -> None:
    tasks: list[Task] = [(number, 0.1, "") for number in range(4)]
    tasks[1] = (1, 0.0, "always dies")
    results = dict(subject.run(work, tasks))
    blamed = results.pop(1)
    assert isinstance(blamed, WorkerLostError)
    assert "its worker died 3 times" in str(blamed)
    assert sorted((index, result[0]) for index, result in results.items()) == [(0, 0), (2, 4), (3, 6)]  # type: ignore[index]


def test_closing_stops_the_workers(recwarn: pytest.WarningsRecorder) -> None:
    """Those of Dask: `test_dask.py`."""
    results = Loky(n_jobs=2).run(work, [(number, 0.0 if number == 0 else 30.0, "") for number in range(5)])
    _, (_, pid) = next(results)  # type: ignore[misc]
    start = time.monotonic()
    results.close()  # type: ignore[attr-defined]
    assert time.monotonic() - start < 15
    wait_for(lambda: not runs(pid), 2)
    assert [str(warning.message) for warning in recwarn] == []


BUSY = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from engine_tasks import begin
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky
import psutil, signal, threading, time

def tell():
    while not Path(sys.argv[3]).exists():
        time.sleep(0.1)
    time.sleep(0.5)
    print(*(process.pid for process in psutil.Process().children(recursive=True)), flush=True)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background jobs
    threading.Thread(target=tell, daemon=True).start()
    for result in {"dask": Dask, "loky": Loky}[sys.argv[2]](n_jobs=2).run(begin, [sys.argv[3]]):
        pass
"""


def busy(name: str, folder: Path) -> Iterator[Any]:
    """A process with a worker that has nothing to do and one that has, and their ids."""
    (folder / "busy.py").write_text(BUSY)
    process = subprocess.Popen(
        [sys.executable, folder / "busy.py", ROOT / "tests" / "support", name, folder / "begun"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(folder)},
    )
    assert process.stdout is not None
    yield process
    yield list(map(int, process.stdout.readline().split()))


@pytest.mark.parametrize("name", NAMES)
def test_workers_end_with_their_parent(name: str, tmp_path: Path) -> None:
    """Even if that was killed, and workers that never had a task."""
    process, pids = busy(name, tmp_path)
    assert len(pids) >= 2
    process.kill()
    process.wait()
    try:
        wait_for(lambda: not any(map(runs, pids)), 8)
    finally:
        for pid in filter(runs, pids):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("name", NAMES)
def test_an_interruption_is_the_parents_business(name: str, tmp_path: Path) -> None:
    """Ctrl-C goes to workers too, which say nothing about it."""
    process, pids = busy(name, tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert err.count("Traceback") == 1, err
    assert err.rstrip().endswith("KeyboardInterrupt")
    wait_for(lambda: not any(map(runs, pids)), 3)
    assert list(tmp_path.glob("simbias-*")) == []
