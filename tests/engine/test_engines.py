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

import psutil
import pytest
from conftest import ROOT
from engine_tasks import Task, Trap, call, examine, hand_over, hand_over_a_view, set_trap, work
from threadpoolctl import threadpool_limits

from simbias.config import compose
from simbias.config.build import service
from simbias.engine.contract import Engine, WorkerLostError
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky, RoundBrokenError, run_rounds
from simbias.engine.sequential import Sequential

pytestmark = pytest.mark.slow

HAS_DASK = importlib.util.find_spec("distributed") is not None
NAMES = ["loky", *(["dask"] if HAS_DASK else [])]
WORKERS = [Loky(n_jobs=2), *([Dask(n_jobs=2)] if HAS_DASK else [])]
ENGINES = [Sequential(), Loky(n_jobs=1), *WORKERS]


def name_of(subject: Any) -> str:
    return type(subject).__name__


def numbers(results: Any) -> list[tuple[int, int]]:
    return sorted((index, result[0]) for index, result in results)


def is_gone(pid: int) -> bool:
    """Whether a process has ended, be it that nobody fetched its exit status."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def eventually(seconds: float, condition: Any) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.1)
    return condition()


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


@pytest.mark.parametrize("subject", ENGINES, ids=name_of)
def test_each_task_has_its_result_once(subject: Engine) -> None:
    """The one that it has here: Dask looks into arguments for keys and calls, which is none of its business.

    Dask has no more tasks at a time than two for each worker.
    """
    things = [{"a": ("x", [1, {"b": (None, len)}])}, (max, 1, 2), "_run_alone"]
    others = [(examine, (0.1 * k, thing)) for k, thing in enumerate(things)]
    others.append((hand_over_a_view, {"a": 1}))
    tasks = Counted([*others, *((work, (number, 0.0, "")) for number in range(200))])
    results = []
    with threadpool_limits(1):
        for result in subject.run(call, tasks):
            results.append(result)
            assert not isinstance(subject, Dask) or tasks.starts - len(results) < 2 * 2
        found = dict(results)
        assert [found.pop(index) for index in range(len(others))] == list(map(call, others))
    assert len(results) == len(tasks)
    assert [found[index][0] for index in sorted(found)] == [2 * number for number in range(200)]
    assert list(subject.run(work, [])) == []


@pytest.mark.parametrize("subject", WORKERS, ids=name_of)
def test_a_worker_that_dies_once_loses_nothing(subject: Engine, tmp_path: Path) -> None:
    """Nor does one that dies as it sends a result."""
    tasks: list[Any] = [(work, (number, 0.1, "")) for number in range(8)]
    tasks[3] = (work, (3, 0.1, str(tmp_path / "died")))
    tasks.append((set_trap, str(tmp_path / "died as well")))
    results = list(subject.run(call, tasks))
    found = dict(results)
    assert len(results) == len(found) == len(tasks)
    assert type(found.pop(8)) is Trap
    assert numbers(found.items()) == [(i, 2 * i) for i in range(8)]
    assert {file.name for file in tmp_path.iterdir()} >= {"died", "died as well"}
    assert os.getpid() not in {result[1] for result in found.values()}  # type: ignore[index]


@pytest.mark.parametrize("subject", WORKERS, ids=name_of)
def test_a_worker_may_die_while_it_hands_over_its_result(subject: Engine, tmp_path: Path) -> None:
    """Half a result is none: nobody waits for the other half."""
    tasks = [(seconds, str(tmp_path / str(seconds))) for seconds in (0.15, 0.35)]
    results = dict(subject.run(hand_over, tasks))
    assert [results[index].size for index in range(2)] == [20_000_000] * 2


@pytest.mark.parametrize("subject", WORKERS, ids=name_of)
def test_only_the_task_that_kills_its_workers_is_blamed(subject: Engine) -> None:
    tasks: list[Task] = [(number, 0.1, "") for number in range(6)]
    tasks[1] = (1, 0.0, "always dies")
    results = dict(subject.run(work, tasks))
    assert "its worker died 3 times" in str(results[1])
    assert isinstance(results.pop(1), WorkerLostError)
    assert numbers(results.items()) == [(i, 2 * i) for i in (0, 2, 3, 4, 5)]


@pytest.mark.parametrize("subject", WORKERS, ids=name_of)
def test_closing_stops_the_workers(subject: Engine, recwarn: pytest.WarningsRecorder) -> None:
    results = subject.run(work, [(number, 0.0 if number == 0 else 30.0, "") for number in range(5)])
    _, (_, pid) = next(results)  # type: ignore[misc]
    start = time.monotonic()
    results.close()  # type: ignore[attr-defined]
    assert time.monotonic() - start < 15
    assert eventually(2, lambda: is_gone(pid))
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
    time.sleep(1)
    for process in psutil.Process().children(recursive=True):
        print(process.pid, flush=True)
    print("all", flush=True)

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
    yield [int(line) for line in iter(process.stdout.readline, "all\n")]


@pytest.mark.parametrize("name", NAMES)
def test_workers_end_with_their_parent(name: str, tmp_path: Path) -> None:
    """Even if that was killed, and workers that never had a task."""
    process, pids = busy(name, tmp_path)
    assert len(pids) >= 2
    process.kill()
    process.wait()
    try:
        assert eventually(8, lambda: all(is_gone(pid) for pid in pids))
    finally:
        for pid in pids:
            if not is_gone(pid):
                os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("name", NAMES)
def test_an_interruption_is_the_parents_business(name: str, tmp_path: Path) -> None:
    """Ctrl-C goes to workers too, which say nothing about it."""
    process, pids = busy(name, tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert err.count("Traceback") == 1, err
    assert err.rstrip().endswith("KeyboardInterrupt")
    assert eventually(3, lambda: all(is_gone(pid) for pid in pids))
    assert list(tmp_path.glob("simbias-*")) == []


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

    results = dict(run_rounds(breaking, ["a", "b", "c"]))
    assert isinstance(results.pop(2), WorkerLostError)
    assert results == {0: 0, 1: 1}
    assert rounds[:2] == [([0, 1, 2], False)] * 2
    assert all(alone and len(batch) == 1 for batch, alone in rounds[2:])


@pytest.mark.parametrize("name", ["sequential", *NAMES])
def test_engines_are_built_from_their_yaml(name: str) -> None:
    subject = service(compose([f"engine={name}"]), "engine", Engine)
    assert type(subject).__module__ == f"simbias.engine.{name}"
