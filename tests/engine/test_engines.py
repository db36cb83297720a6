"""Every engine gives every result once, whatever becomes of its workers."""

import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from engine_tasks import HANDED_OVER, call, examine, hand_over, hand_over_a_view, work
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
HALF = 4  # which task hands over half a result


class Counted(Sequence):
    """Tasks that note which were taken out."""

    def __init__(self, tasks: list[Any]) -> None:
        self.tasks, self.taken = tasks, set[int]()

    def __len__(self) -> int:
        return len(self.tasks)

    def __getitem__(self, index: Any) -> Any:
        task = self.tasks[index]
        self.taken.add(index)
        return task


Ran = tuple[Engine, list[Any], dict[int, Any]]


@pytest.fixture(
    scope="module", params=[Sequential(), Loky(n_jobs=1), *WORKERS], ids=lambda e: type(e).__name__
)
def ran(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """An engine, tasks, and the results that it gives; workers die of one task always, of another one once.

    That one's worker dies while it hands over half a result. Dask looks into arguments for keys and calls,
    which is none of its business. It has no more tasks at a time than two for each worker.
    """
    things = [{"a": ("x", [1, {"b": (None, len)}])}, (max, 1, 2), "_run_alone"]
    listed = [*((examine, (0.1 * k, thing)) for k, thing in enumerate(things)), (hand_over_a_view, {"a": 1})]
    listed += ((work, (number, 0.1 * (number < 4), "")) for number in range(NUMBERS))
    if request.param in WORKERS:
        fate = tmp_path_factory.mktemp("fate") / "half"
        listed[HALF:HALF] = [(hand_over, (0.1, str(fate))), (work, (0, 0.0, "always dies"))]
    tasks, results = Counted(listed), []
    with threadpool_limits(1):
        for result in request.param.run(call, tasks):
            results.append(result)
            assert not isinstance(request.param, Dask) or len(tasks.taken) - len(results) < 3 * 2
    assert len(results) == len(listed)
    return request.param, listed, dict(results)


def test_each_task_has_its_result_once(ran: Ran) -> None:
    """The one that it has here."""
    subject, tasks, results = ran
    assert set(results) == set(range(len(tasks)))
    with threadpool_limits(1):
        assert [results[index] for index in range(HALF)] == list(map(call, tasks[:HALF]))
    numbers, pids = zip(*(results[index] for index in range(len(tasks) - NUMBERS, len(tasks))), strict=True)
    assert numbers == tuple(range(0, 2 * NUMBERS, 2))
    assert (os.getpid() in pids) == (subject not in WORKERS)
    assert list(subject.run(work, [])) == []


def test_only_the_task_that_kills_its_workers_is_blamed(ran: Ran) -> None:
    subject, _, results = ran
    blamed = {index: each for index, each in results.items() if isinstance(each, WorkerLostError)}
    assert set(blamed) == ({HALF + 1} if subject in WORKERS else set())
    assert all("its worker died 3 times" in str(each) for each in blamed.values())
    assert subject not in WORKERS or np.size(results[HALF]) == HANDED_OVER


def test_closing_stops_the_workers(recwarn: pytest.WarningsRecorder) -> None:
    """Those of Dask: `test_dask.py`."""
    results = Loky(n_jobs=2).run(work, [(number, 0.0 if number == 0 else 30.0, "") for number in range(5)])
    _, (_, pid) = next(results)  # type: ignore[misc]
    start = time.monotonic()
    results.close()
    assert time.monotonic() - start < 15
    wait_for(lambda: not runs(pid), 2)
    assert [str(warning.message) for warning in recwarn] == []


BUSY = """
import os, signal, sys, threading, time, traceback
sys.path.insert(0, sys.argv[1])
from engine_tasks import begin
from simbias.engine.dask import Dask
from simbias.engine.loky import Loky
import psutil

def tell(files):
    while not all(map(os.path.exists, files)):
        time.sleep(0.02)
    print(*(process.pid for process in psutil.Process().children(recursive=True)), flush=True)

def run(name, tasks):
    for result in {"dask": Dask, "loky": Loky}[name](n_jobs=2).run(begin, tasks):
        pass

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background jobs
    ending, *names = sys.argv[2:]
    if ending == "killed":  # with workers that never had a task
        for name in names:
            threading.Thread(target=run, args=(name, [(name, 60)])).start()
        tell(names)
    for name in names:  # interrupted, when both workers have started
        threading.Thread(target=tell, args=[[name, f"{name} too"]]).start()
        try:
            run(name, [(name, 60), (f"{name} too", 0)])
        except KeyboardInterrupt:
            traceback.print_exc()
"""


def busy(ending: str, folder: Path) -> subprocess.Popen[str]:
    """A process whose engines have a worker that has nothing to do and one that has; it tells their ids."""
    folder.mkdir()
    (folder / "busy.py").write_text(BUSY)
    return subprocess.Popen(
        [sys.executable, "busy.py", ROOT / "tests" / "support", ending, *NAMES],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(folder), "PYTHONPATH": str(ROOT)},
    )


def told(process: subprocess.Popen[str]) -> list[int]:
    """The ids of the next workers."""
    assert process.stdout is not None
    pids = list(map(int, process.stdout.readline().split()))
    assert len(pids) >= 2
    return pids


def test_workers_end_with_their_parent(tmp_path: Path) -> None:
    """However it ends, whether they work or not. Of Ctrl-C, which goes to them too, they say nothing."""
    interrupted, pids = busy("interrupted", tmp_path / "interrupted"), []
    for _ in NAMES:
        pids += told(interrupted)
        os.killpg(interrupted.pid, signal.SIGINT)
    killed = busy("killed", tmp_path / "killed")  # while the other one ends
    pids += told(killed)
    killed.kill()
    killed.communicate()
    _, err = interrupted.communicate(timeout=60)
    assert err.count("Traceback") == err.count("\nKeyboardInterrupt") == len(NAMES), err
    assert list(tmp_path.glob("interrupted/simbias-*")) == []
    try:
        wait_for(lambda: not any(map(runs, pids)), 8)
    finally:
        for pid in filter(runs, pids):
            os.kill(pid, signal.SIGKILL)
