"""Workers of a Dask cluster."""

from __future__ import annotations

import logging
import re
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from pydantic import FilePath

from simbias.core.errors import ConfigError
from simbias.core.extras import library
from simbias.core.messages import quote, words
from simbias.core.ranges import Workers
from simbias.engine.contract import MOST_LOSSES, Engine, R, T, WorkerLostError
from simbias.engine.workplace import tidy, workplace

if TYPE_CHECKING:
    from distributed import Client, Future
    from distributed.security import Security

ADDRESS = re.compile(r"(\w+://)?(\[[\da-fA-F:.]+\]|[\w.-]+):\d{1,5}/?")
CONNECT_SECONDS = 5.0
RECOUNT_SECONDS = 1.0  # between two looks at how many workers there are
LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMBA")


@dataclass(frozen=True)
class Certificates:
    """PEM files by which a cluster and its client know each other; without `key`, `cert` holds it too."""

    ca_file: FilePath | None = None
    cert: FilePath | None = None
    key: FilePath | None = None

    def __post_init__(self) -> None:
        if (self.ca_file is None) != (self.cert is None) or (self.key and not self.cert):
            raise ValueError("tls needs a ca_file and a cert")


class Dask(Engine):
    """Tasks as futures of a Dask cluster: one's own, or one of this machine alone.

    The local cluster talks TLS with certificates of its own, so that no other user of the machine gets in.

    Parameters
    ----------
    address
        Of a scheduler, whose workers can import simbias and have one thread each; None for a local cluster.
    n_jobs
        Workers of the local cluster.
    tls
        Certificates for a tls:// address; without any, those of Dask's own configuration.
    """

    def __init__(
        self, address: str | None = None, n_jobs: Workers = 2, tls: Certificates | None = None
    ) -> None:
        self._address = address
        self._tls = tls if tls and tls.ca_file else None
        self.n_jobs = n_jobs
        if address and not ADDRESS.fullmatch(address):
            raise ValueError(f"address must be like tls://host:8786, got {quote(address)}")
        if self._tls and not (address or "").startswith("tls://"):
            raise ValueError("tls is for an address that begins with tls://")
        if address and not address.startswith("tls://") and not _is_loopback(address):
            _warn_of_open(address)

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Yield indices and results as tasks end."""
        if not tasks:
            return
        with self._client() as client:
            yield from self._results(client, function, tasks)

    @contextmanager
    def _client(self) -> Iterator[Client]:
        """A client of the cluster. When it is closed, Dask drops its tasks; a local cluster ends with it."""
        Client = _library("distributed", "Dask").Client
        if self._address is not None:
            client = _connection(self._address, _security(self._tls))
            try:
                yield client
            finally:
                with suppress(Exception):  # Dask's, of a scheduler that is gone: would hide the reason
                    client.close()
        else:
            with _local_cluster(self.n_jobs) as cluster, Client(cluster, set_as_default=False) as client:
                yield client

    def _results(
        self, client: Client, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Results of all tasks.

        Dask blames a dead worker on all tasks that waited there. So a task that lost its workers runs alone
        at the end, before it is to blame.
        """
        from distributed import KilledWorker

        losses: Counter[int] = Counter()
        indices, suspects = deque(range(len(tasks))), deque[int]()
        for index, result in self._outcomes(client, function, tasks, indices):
            if not isinstance(result, KilledWorker):
                yield index, result
                continue
            losses[index] += result.allowed_failures + 1
            (indices if losses[index] < MOST_LOSSES - 1 else suspects).append(index)
        for index in suspects:
            for _, result in self._outcomes(client, function, tasks, deque([index])):
                if isinstance(result, KilledWorker):
                    count = losses[index] + result.allowed_failures + 1
                    result = WorkerLostError(f"its worker died {count} times")
                yield index, result

    def _outcomes(
        self, client: Client, function: Callable, tasks: Sequence, indices: deque[int]
    ) -> Iterator[tuple[int, Any]]:
        """Results of the tasks of these indices, more of which may be added meanwhile, or a KilledWorker.

        Two tasks for each worker are with Dask at a time: one that runs, and one that waits to.
        """
        from distributed import KilledWorker, as_completed

        futures: dict[Future, int] = {}
        # With with_results=True it would wait for ever for a result that is lost with its worker.
        ended = as_completed([], loop=client.loop)
        last_count, workers = -RECOUNT_SECONDS, 1
        while indices or futures:
            if time.monotonic() - last_count >= RECOUNT_SECONDS:
                last_count, workers = time.monotonic(), self._count_workers(client)
            while indices and len(futures) < 2 * workers:
                index = indices.popleft()
                future = client.submit(partial(_run_alone, function, tasks[index]), pure=False)
                futures[future] = index
                ended.add(future)
            future = next(ended)
            try:
                result = future.result()  # of a task, which raises nothing
            except KilledWorker as error:
                result = error
            except CancelledError as error:
                problem = f"{self._address or 'local'}: the scheduler is gone"
                raise ConfigError("engine.address", problem) from error
            yield futures.pop(future), result

    def _count_workers(self, client: Client) -> int:
        """How many there are, at least one: where there are none yet, Dask waits for some."""
        try:
            threads = client.nthreads()
        except OSError as error:
            raise ConfigError("engine.address", f"{self._address}: the scheduler is gone") from error
        for worker, count in threads.items():
            if count > 1:  # trials set what their process has but once, as the threads of linear algebra
                raise ConfigError(
                    "engine.address", f"{worker} has {count} threads; start workers with --nthreads 1"
                )
        return max(1, len(threads))


def _library(module: str, name: str) -> Any:
    """A module of simbias[dask]; a ConfigError where it is missing."""
    try:
        return library(module, name, "dask")
    except ValueError as error:
        raise ConfigError("engine", words(error)) from error


def _run_alone(function: Callable[[T], R], task: T) -> R:
    """Run a task, its worker's libraries on one thread each."""
    _limit_threads()
    return function(task)


@cache
def _limit_threads() -> None:
    """Once in a worker, whose environment may be another's."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)


def dask_setup(worker: object) -> None:
    """In a worker of the local cluster, as it starts: leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Processes of this machine that only we can talk to.

    The folder is ours too, since Dask's own one may be another user's.
    """
    import dask
    from distributed import LocalCluster

    _library("cryptography", "cryptography")  # which Dask's TLS needs
    tidy()
    no_pages: dict[str, list[str]] = {
        f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker")
    }
    with dask.config.set(no_pages):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            security=True,
            protocol="tls",
            local_directory=str(workplace()),
            scheduler_kwargs={
                "allowed_failures": 0,  # we count them
                "dashboard": False,
                "dashboard_address": "127.0.0.1:0",  # any free port, where nothing is shown
            },
            silence_logs=logging.CRITICAL,  # of workers that died, which is dealt with
            env={f"{name}_NUM_THREADS": "1" for name in LIBRARIES},
            preload=[__name__],  # calls dask_setup
        )
    with cluster:
        yield cluster


def _connection(address: str, security: Security | None) -> Client:
    """A client of the scheduler at an address.

    It is made in a thread, since Dask waits for ever where something takes the connection and says nothing.
    """
    from distributed import Client

    outcome: list[Client | Exception] = []

    def connect() -> None:
        try:
            outcome.append(Client(address, security=security, timeout=CONNECT_SECONDS, set_as_default=False))
        except Exception as error:
            outcome.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(CONNECT_SECONDS + 1)
    if not outcome:
        raise ConfigError("engine.address", f"{address}: no scheduler answers")
    if isinstance(outcome[0], Exception):
        raise ConfigError("engine.address", f"{address}: no scheduler answers") from outcome[0]
    return outcome[0]


def _security(tls: Certificates | None) -> Security | None:
    """Dask's form of certificates; None leaves it to Dask's configuration."""
    from distributed.security import Security

    if tls is None:
        return None
    key = tls.key or tls.cert
    return Security(
        require_encryption=True,
        tls_ca_file=str(tls.ca_file),
        tls_client_cert=str(tls.cert),
        tls_client_key=str(key),
    )


def _is_loopback(address: str) -> bool:
    """Whether an address is one of this machine alone."""
    host = urlsplit(address if "://" in address else f"tcp://{address}").hostname or ""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@cache
def _warn_of_open(address: str) -> None:
    """One line, once."""
    logging.getLogger(__name__).warning(
        "simbias: engine.address: %s is not encrypted: who reaches it can run code here and there; use tls://",
        address,
    )
