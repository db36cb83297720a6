"""Workers of a Dask cluster."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from simbias.core.errors import ConfigError
from simbias.core.extras import library, silent
from simbias.core.ranges import Workers
from simbias.engine.contract import (
    Engine,
    EngineLostError,
    R,
    Results,
    T,
    WorkplaceError,
)
from simbias.engine.task_queue import TaskQueue
from simbias.engine.workplace import workplace

if TYPE_CHECKING:
    from distributed import Client, Future, as_completed

CONNECT_SECONDS = 5.0
JOIN_SECONDS = 5.0  # without a worker, until a line says so
POLL_SECONDS = 0.1  # between checks for finished tasks, like Dask's own
LOGGER = "distributed.client"  # logs, with a traceback, that the scheduler is gone
UNREADABLE = "deserialization"  # Dask's word for a task that a worker cannot unpickle


class Dask(Engine):
    """Tasks as futures of a Dask cluster: the user's, or a local one on this machine.

    The local cluster uses TLS with temporary certificates, so that no other user of the machine has access.

    Parameters
    ----------
    address
        Address of a scheduler, whose workers can import simbias and have one thread each; None: a local
        cluster. Certificates for a tls:// address come from Dask's own configuration.
    n_jobs
        Workers of the local cluster.
    """

    def __init__(self, address: str | None = None, n_jobs: Workers = 2) -> None:
        library("distributed", "Dask", "dask")
        self._address = address
        self.shares_disk = address is None  # otherwise not known to share one
        self.n_jobs = n_jobs if address is None else 1  # at least one: a cluster's workers come and go
        self._waits = False  # whether it waits for a worker, which was reported

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T], code: Callable[[], bytes] = bytes
    ) -> Results[R]:
        """Yield indices and results as tasks end; `code` is sent to a cluster at an address.

        Sweeps with other code may run there at the same time: each task sees that of its own sweep.

        Dask holds two tasks per worker at a time: one running, one waiting.
        """
        if not tasks:
            return
        from distributed import KilledWorker, as_completed

        queue = TaskQueue(len(tasks))
        futures: dict[Future, int] = {}
        with (
            silent(LOGGER),
            self._client() as client,
            self._scheduler_in_reach(),
            _sent(client, b"" if self._address is None else code()) as home,
        ):
            # With with_results=True, it would wait forever for a result lost with its worker.
            ended = as_completed([], loop=client.loop)
            while queue or futures:
                while queue.ready(alone=not futures) and len(futures) < 2 * max(1, len(_workers(client))):
                    index, preferred = queue.take(_workers(client))
                    # Without partial, Dask would search the arguments for calls.
                    call = partial(_at_worker, function, tasks[index], home)
                    future = client.submit(
                        call,
                        pure=False,
                        workers=preferred or None,
                        allow_other_workers=bool(preferred),  # if these are lost
                    )
                    futures[future] = index
                    ended.add(future)
                future = self._next(ended, client)
                index = futures.pop(future)
                try:
                    result = future.result()  # a task raises nothing
                except KilledWorker as error:
                    if blamed := queue.lost(index, error):
                        yield index, blamed
                except WorkplaceError as error:
                    if blamed := queue.refused(index, error):
                        yield index, blamed
                except RuntimeError as error:
                    if UNREADABLE not in str(error):
                        raise
                    problem = "a worker cannot read what it is sent; is its version of simbias the same?"
                    raise ConfigError("engine.address", problem) from error
                else:
                    yield index, result

    @contextmanager
    def _client(self) -> Iterator[Client]:
        """A client of the cluster. On closing it, Dask drops its tasks, and a local cluster ends."""
        from distributed import Client

        if self._address is None:
            with _local_cluster(self.n_jobs) as cluster, Client(cluster, set_as_default=False) as client:
                yield client
            return
        try:
            client = Client(self._address, timeout=CONNECT_SECONDS, set_as_default=False)
        except Exception as error:  # also for an invalid address
            raise ConfigError("engine.address", f"{self._address}: no scheduler answers") from error
        try:
            self._await_worker(client)
            _check_workers(client)
            yield client
        finally:
            with suppress(Exception):  # from a lost scheduler: would hide the reason
                client.close()

    def _next(self, ended: as_completed, client: Client) -> Future:
        """The next finished future; all workers may be lost meanwhile."""
        looks = time.monotonic() + JOIN_SECONDS
        while not ended.has_ready():
            time.sleep(POLL_SECONDS)
            if time.monotonic() > looks:
                self._await_worker(client)
                looks = time.monotonic() + JOIN_SECONDS
        self._waits = False
        return next(ended)

    def _await_worker(self, client: Client) -> None:
        """Report once if there is no worker for a while; Dask waits for one."""
        try:
            client.wait_for_workers(1, timeout=JOIN_SECONDS)
            self._waits = False
        except TimeoutError:
            if not self._waits:
                waiting = "simbias: the scheduler at %s has no worker; waiting for one"
                logging.getLogger(__name__).warning(waiting, self._address or "a local address")
            self._waits = True

    @contextmanager
    def _scheduler_in_reach(self) -> Iterator[None]:
        """Report if the scheduler ends."""
        try:
            yield
        except (CancelledError, OSError) as error:
            problem = f"the scheduler at {self._address or 'a local address'} is gone"
            raise EngineLostError("", problem) from error


@contextmanager
def _sent(client: Client, packed: bytes) -> Iterator[str]:
    """Send a sweep's code to all workers, and to later ones while it runs; yield its place in their folders.

    The place is "" without code.
    """
    from simbias.engine.sent_code import SentCode

    if not packed:
        yield ""
        return
    plugin = SentCode(packed)

    # Sent by value, as the scheduler may lack simbias.
    def forget(dask_scheduler: Any, name: str = plugin.name) -> None:
        dask_scheduler.worker_plugins.pop(name, None)

    client.register_plugin(plugin)
    try:
        yield plugin.home
    finally:
        if client.status == "running":  # otherwise the scheduler is lost
            with suppress(Exception):  # would hide the reason of an early end
                client.run_on_scheduler(forget)  # workers, which may be busy, are not waited for


def _check_workers(client: Client) -> None:
    """Refuse workers with another version of simbias, which might crash, so that Dask waits for others.

    Workers that join later refuse each trial themselves.
    """

    def digest_there() -> str | None:  # a local function is sent by value, not as a name in simbias
        try:
            from simbias.core.platform import package_digest
        except ImportError:
            return None
        return package_digest()

    here = digest_there()
    for worker, digest in client.run(digest_there).items():
        if digest != here:
            problem = f"{worker} has another version of simbias, or none; install this version there"
            raise ConfigError("engine.address", problem)


def _workers(client: Client) -> list[str]:
    """The workers' addresses; if there are none yet, Dask waits for some."""
    threads = client.nthreads()
    for worker, count in threads.items():
        if count > 1:  # trials change process-wide settings, such as threads of linear algebra
            problem = f"{worker} has {count} threads; start workers with --nthreads 1"
            raise ConfigError("engine.address", problem)
    return list(threads)


def _at_worker(function: Callable[[T], R], task: T, home: str) -> R:
    """The result of a task, with its sweep's code; if it cannot begin here, the error names the worker."""
    from distributed import get_worker

    from simbias.engine.sent_code import use

    worker = get_worker()
    try:
        use(home, worker)
        return function(task)
    except WorkplaceError as error:
        raise WorkplaceError(error.problem, worker.address) from None


def dask_setup(worker: object) -> None:
    """Set up a worker of the local cluster to leave Ctrl-C to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """A local cluster of processes that only this user can access, in a private folder."""
    import dask
    from distributed import LocalCluster

    pages: dict[str, list[str]] = {f"distributed.{role}.http.routes": [] for role in ("scheduler", "worker")}
    with (
        dask.config.set(pages),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            security=True,
            protocol="tls",
            local_directory=str(workplace()),
            scheduler_kwargs={"allowed_failures": 0, "dashboard": False},  # we count failures
            dashboard_address="127.0.0.1:0",  # any free port; nothing is shown there
            silence_logs=logging.CRITICAL,  # about dead workers, which are handled
            env={"NUMBA_NUM_THREADS": "1"},  # as Dask does for other libraries
            preload=[__name__],  # calls dask_setup
        ) as cluster,
    ):
        yield cluster
