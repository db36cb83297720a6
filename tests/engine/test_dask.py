"""A cluster: its address, its certificates, and who is kept out."""

import asyncio
import importlib
import io
import logging
import os
import sys
import threading
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from engine_tasks import begin, begin_elsewhere, see, work
from processes import runs, wait_for

from simbias.config import ConfigError, compose
from simbias.config.build import service
from simbias.engine import dask as module
from simbias.engine import task_queue
from simbias.engine.contract import Engine, EngineLostError, WorkplaceError
from simbias.engine.dask import Dask

pytestmark = pytest.mark.slow

distributed = pytest.importorskip("distributed")
connect = pytest.importorskip("distributed.comm").connect


def hide() -> None:
    sys.modules["simbias.core.platform"] = None  # type: ignore[assignment]  # (as if it were not there)


def alter() -> None:
    module = importlib.import_module("simbias.core.platform")
    module.package_digest = lambda: "another"  # type: ignore[attr-defined]


def restore() -> None:
    del sys.modules["simbias.core.platform"]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A cluster at an address, as an administrator starts it."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster


def test_an_address(cluster: Any, tmp_path: Path) -> None:
    """Closing drops what waits there."""
    composed = compose(["engine=dask", f"engine.address={cluster.scheduler_address}"])
    results = service(composed, "engine", Engine).run(
        begin, [(str(tmp_path / str(number)), 0.3) for number in range(4)]
    )
    _, pid = next(results)
    assert pid != os.getpid()
    results.close()
    time.sleep(0.4)
    assert len(list(tmp_path.iterdir())) <= 2
    assert cluster.scheduler.tasks == {}


def test_a_function_that_workers_lack_is_an_error(cluster: Any) -> None:
    def raises(_: int) -> int:
        raise ModuleNotFoundError("No module named 'mine'")

    with pytest.raises(ModuleNotFoundError, match="mine"):
        list(Dask(address=cluster.scheduler_address).run(raises, [1]))


def test_workers_of_another_simbias_are_one_line(cluster: Any) -> None:
    another = r"engine\.address: tcp://.* has another version of simbias, or none"
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        for change in (hide, alter):
            client.run(change)
            try:
                with pytest.raises(ConfigError, match=another):
                    list(Dask(address=cluster.scheduler_address).run(str, [1]))
            finally:
                client.run(restore)


def test_workers_of_many_threads_are_refused() -> None:
    threads = {"n_workers": 1, "threads_per_worker": 2, "processes": False}
    refused = r"engine\.address: .* has 2 threads; start workers with --nthreads 1"
    with (
        distributed.LocalCluster(**threads, protocol="tcp", dashboard_address=":0") as cluster,
        pytest.raises(ConfigError, match=refused),
    ):
        list(Dask(address=cluster.scheduler_address).run(str, [1]))


def own_listeners() -> list[Any]:
    """Where this process and its children listen."""
    us = psutil.Process()
    connections = [c for process in (us, *us.children(recursive=True)) for c in process.net_connections()]
    return [connection.laddr for connection in connections if connection.status == psutil.CONN_LISTEN]


async def attempts(ports: Iterable[int]) -> list[Any]:
    """What comes of talking Dask at these ports, without a certificate and with one of somebody else's."""
    others = distributed.Security.temporary().get_connection_args("client")
    return await asyncio.gather(
        *(connect(f"tcp://127.0.0.1:{port}", timeout=0.5) for port in ports),
        *(connect(f"tls://127.0.0.1:{port}", timeout=0.5, **others) for port in ports),
        return_exceptions=True,
    )


def test_the_local_cluster_is_closed_to_outsiders(recwarn: pytest.WarningsRecorder) -> None:
    """Of all ports none talks Dask without the certificate or has a page, and none is for other machines.

    Closed before its tasks end, it ends quietly; soon: `test_workers_end_with_their_parent`.
    """
    before = set(own_listeners())
    results = Dask(n_jobs=1).run(work, [(number, 1.0 if number else 0.0, "") for number in range(3)])
    _, (_, pid) = next(results)  # type: ignore[misc]
    listeners, encrypted, codes = set(own_listeners()) - before, [], []
    assert {ip for ip, _ in listeners} == {"127.0.0.1"}
    for ip, port in listeners:
        try:
            with urllib.request.urlopen(f"http://{ip}:{port}/health", timeout=1) as page:
                codes.append(page.status)
        except urllib.error.HTTPError as error:
            codes.append(error.code)
        except OSError:
            encrypted.append(port)
    assert set(codes) <= {404}
    assert len(encrypted) >= 3  # scheduler, nanny, worker
    assert all(isinstance(each, OSError) for each in asyncio.run(attempts(encrypted)))
    recwarn.clear()
    results.close()
    wait_for(lambda: not runs(pid), 2)
    assert [str(warning.message) for warning in recwarn] == []


def test_no_scheduler_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.3)
    for address in ("tcp://127.0.0.1:9", "nonsense://x:1", "no port"):
        with pytest.raises(ConfigError, match=rf"engine\.address: {address}: no scheduler answers"):
            list(Dask(address).run(str, [1]))
        assert Dask(address, n_jobs=8).n_jobs == 1  # those of a local cluster tell nothing of this one


def test_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        ConfigError, match=r"^engine: Dask is not installed .*: pip install 'simbias\[dask\]'$"
    ):
        service(compose(["engine=dask"]), "engine", Engine)


def test_a_worker_is_waited_for_and_a_line_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "JOIN_SECONDS", 0.2)
    inside = {"n_workers": 0, "threads_per_worker": 1, "processes": False, "protocol": "tcp"}
    with distributed.LocalCluster(**inside, dashboard_address=":0") as cluster:
        threading.Timer(0.6, cluster.scale, [1]).start()
        address = cluster.scheduler_address
        results = Dask(address=address).run(begin, 3 * [(os.devnull, 0.5)])
        assert next(results) == (0, os.getpid())
        cluster.scale(0)  # all are lost, amid the sweep
        while cluster.scheduler.workers:
            time.sleep(0.05)
        threading.Timer(2.0, cluster.scale, [1]).start()
        assert sorted(results) == [(1, os.getpid()), (2, os.getpid())]
    said = [each.getMessage() for each in caplog.records if each.name == module.__name__]
    assert said == [f"simbias: the scheduler at {address} has no worker; waiting for one"] * 2


def test_a_worker_at_which_no_task_can_begin_swallows_none(caplog: pytest.LogCaptureFixture) -> None:
    """It is named once; a task that can begin nowhere ends."""
    inside = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "protocol": "tcp"}
    with distributed.LocalCluster(**inside, dashboard_address=":0") as cluster:
        bad, good = (worker.address for worker in cluster.workers.values())
        dask = Dask(address=cluster.scheduler_address)
        assert dict(dask.run(begin_elsewhere, 20 * [[bad]])) == dict.fromkeys(range(20), good)
        (said,) = [each.getMessage() for each in caplog.records if each.name == task_queue.__name__]
        assert said.startswith(f"simbias: a trial cannot begin at {bad}: no room")
        ((_, error),) = dask.run(begin_elsewhere, [[bad, good]])
    assert isinstance(error, WorkplaceError)


def test_sweeps_with_other_code_run_side_by_side(cluster: Any, tmp_path: Path) -> None:
    """Each task sees the modules and files of its own sweep; the scheduler keeps none of them."""

    def packed(version: str) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("home/mine.py", f"VALUE = {version!r}")
            archive.writestr("home/mine.txt", version)
        return stream.getvalue() if version else b""

    versions = ["one", "two", "", "one"]  # one without code; two of equal code
    dask, tasks = Dask(address=cluster.scheduler_address), 5 * [str(tmp_path / "conf")]
    sweeps = [dask.run(see, tasks, partial(packed, version)) for version in versions]
    for _ in range(5):
        assert [next(sweep)[1] for sweep in sweeps] == [(version, version) for version in versions]
    assert [list(sweep) for sweep in sweeps] == 4 * [[]]
    assert not any(name.startswith("simbias") for name in cluster.scheduler.worker_plugins)


def test_a_scheduler_that_ends_ends_the_sweep(
    cluster: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The last test of this cluster."""
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.3)
    tasks = [(os.devnull, 0.5 if number else 0.0) for number in range(9)]
    results = Dask(address=cluster.scheduler_address).run(begin, tasks)
    next(results)
    logging.getLogger(module.LOGGER).addHandler(caplog.handler)  # as Dask's loggers do not propagate
    cluster.close()
    with pytest.raises(EngineLostError, match=rf"^the scheduler at {cluster.scheduler_address} is gone$"):
        list(results)
    logging.getLogger(module.LOGGER).removeHandler(caplog.handler)
    assert module.LOGGER not in {each.name for each in caplog.records}
