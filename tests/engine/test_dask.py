"""A cluster: its address, its certificates, and who is kept out."""

from __future__ import annotations

import importlib
import os
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from simbias.config import ConfigError, compose
from simbias.config.build import service
from simbias.engine import dask as module
from simbias.engine.contract import Engine
from simbias.engine.dask import Dask

pytestmark = pytest.mark.slow

distributed = pytest.importorskip("distributed")


def double(number: int) -> int:
    return 2 * number


def where(_: int) -> int:
    return os.getpid()


def hide() -> None:
    sys.modules["simbias.core.platform"] = None  # type: ignore[assignment]  # (as if it were not there)


def alter() -> None:
    module = importlib.import_module("simbias.core.platform")
    module.package_digest = lambda: "another"  # type: ignore[attr-defined]


def restore() -> None:
    del sys.modules["simbias.core.platform"]


def wait_and_write(task: tuple[float, str]) -> None:
    seconds, file = task
    Path(file).touch()
    time.sleep(seconds)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A cluster at an address, as an administrator starts it."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster


def test_an_address(cluster: Any) -> None:
    subject = service(
        compose(["engine=dask", f"engine.address={cluster.scheduler_address}"]), "engine", Engine
    )
    assert isinstance(subject, Dask)
    assert dict(subject.run(double, [1, 2, 3])) == {0: 2, 1: 4, 2: 6}
    assert os.getpid() not in dict(subject.run(where, [0])).values()


def test_closing_drops_what_waits_at_an_address(cluster: Any, tmp_path: Path) -> None:
    tasks = [(0.5, str(tmp_path / str(number))) for number in range(4)]
    results = Dask(address=cluster.scheduler_address).run(wait_and_write, tasks)
    next(results)
    results.close()  # type: ignore[attr-defined]
    time.sleep(1.5)
    assert len(list(tmp_path.iterdir())) <= 2
    assert cluster.scheduler.tasks == {}


def test_a_function_that_workers_lack_is_an_error(cluster: Any) -> None:
    def raises(_: int) -> int:
        raise ModuleNotFoundError("No module named 'mine'")

    with pytest.raises(ModuleNotFoundError, match="mine"):
        list(Dask(address=cluster.scheduler_address).run(raises, [1]))


@pytest.mark.parametrize("change", ["hide", "alter"])
def test_workers_of_another_simbias_are_one_line(cluster: Any, change: str) -> None:
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        client.run(globals()[change])
        try:
            with pytest.raises(
                ConfigError, match=r"engine\.address: tcp://.* has another simbias .*, or none"
            ):
                list(Dask(address=cluster.scheduler_address).run(double, [1]))
        finally:
            client.run(restore)


def test_workers_of_many_threads_are_refused() -> None:
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=":0"
        ) as cluster,
        pytest.raises(
            ConfigError, match=r"engine\.address: .* has 2 threads; start workers with --nthreads 1"
        ),
    ):
        list(Dask(address=cluster.scheduler_address).run(double, [1]))


def own_listeners() -> list[Any]:
    """Where this process and its children listen."""
    us = psutil.Process()
    connections = [c for process in (us, *us.children(recursive=True)) for c in process.net_connections()]
    return [connection.laddr for connection in connections if connection.status == psutil.CONN_LISTEN]


def test_the_local_cluster_is_closed_to_outsiders() -> None:
    """Of all ports none talks Dask without the certificate or has a page, and none is for other machines."""
    before = set(own_listeners())
    results = Dask(n_jobs=1).run(double, [1, 2, 3])
    next(results)
    ports = set(own_listeners()) - before
    assert len(ports) >= 3  # scheduler, nanny, worker
    others = distributed.Security.temporary()
    encrypted, codes = 0, []
    for ip, port in ports:
        assert ip == "127.0.0.1"
        try:
            with urllib.request.urlopen(f"http://{ip}:{port}/health", timeout=1):
                pytest.fail("a page")
        except urllib.error.HTTPError as error:
            codes.append(error.code)
            continue
        except OSError:
            encrypted += 1
        for address, security in ((f"tcp://{ip}:{port}", None), (f"tls://{ip}:{port}", others)):
            with pytest.raises(OSError):  # noqa: PT011 (of several kinds)
                distributed.Client(address, security=security, timeout=0.5, set_as_default=False)
    assert encrypted >= 3
    assert set(codes) <= {404}
    assert len(list(results)) == 2


def test_no_scheduler_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.3)
    for address in ("tcp://127.0.0.1:9", "nonsense://x:1", "localhost:9", "no port"):
        with pytest.raises(ConfigError, match=rf"engine\.address: {address}: no scheduler answers"):
            list(Dask(address).run(double, [1]))


def test_a_scheduler_that_ends_ends_the_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 1.0)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster:
        results = Dask(address=cluster.scheduler_address).run(
            wait_and_write, [(0.0, os.devnull)] + [(2.0, os.devnull)] * 3
        )
        next(results)
    with pytest.raises(ConfigError, match=r"engine\.address: .*: the scheduler is gone"):
        list(results)


def test_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        ConfigError, match=r"^engine: Dask is not installed \(.*\): pip install 'simbias\[dask\]'$"
    ):
        service(compose(["engine=dask"]), "engine", Engine)
