"""Workers of a Dask cluster."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

from pydantic import PositiveFloat, PositiveInt

from simbias.config import ConfigError
from simbias.engine.rounds import RoundBrokenError, call, until_done
from simbias.interfaces import Engine, R, T, WorkerLostError

if TYPE_CHECKING:
    from distributed import Client

POLL_SECONDS = 0.5
CONNECT_SECONDS = 10
THREADS = ("OMP", "OPENBLAS", "MKL", "NUMBA")


class Dask(Engine):
    """joblib's Dask backend, on a cluster of one's own or on workers of this machine.

    Parameters
    ----------
    address
        Of a scheduler, whose workers can import simbias; None for a local cluster.
    n_jobs
        Workers of the local cluster.
    patience
        s that the cluster may be idle although results are missing: then those are lost and run again.
    """

    def __init__(
        self, address: str | None = None, n_jobs: PositiveInt = 2, patience: PositiveFloat = 10.0
    ) -> None:
        self._address = address
        self._patience = patience
        self.n_jobs = n_jobs

    def run(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLostError]]:
        """Yield indices and results as tasks end."""
        if not tasks:
            return
        with self._client() as client:
            yield from until_done(partial(self._round, client, function), tasks)

    @contextmanager
    def _client(self) -> Iterator[Client]:
        """A client of the cluster; a local cluster ends with it."""
        try:
            from distributed import Client, LocalCluster
        except ImportError as error:
            raise ConfigError("engine", "dask is not installed; pip install 'simbias[dask]'") from error
        if self._address is not None:
            try:
                client = Client(self._address, timeout=CONNECT_SECONDS)
            except (OSError, ValueError) as error:
                raise ConfigError("engine.address", f"{self._address}: no scheduler answers") from error
            with client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=self.n_jobs,
                threads_per_worker=1,
                dashboard_address=None,
                silence_logs=logging.CRITICAL,  # of workers that died, which is dealt with
                env={f"{name}_NUM_THREADS": "1" for name in THREADS},
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client

    def _round(
        self, client: Client, function: Callable, calls: Iterable[tuple[int, Any]], alone: bool
    ) -> Iterator[tuple[int, Any]]:
        """Results of the calls, until the cluster has nothing to do although some are missing.

        joblib waits for ever for a task that Dask gave up, so it waits in a thread of its own.
        """
        results: queue.SimpleQueue[Any] = queue.SimpleQueue()
        feeder = partial(_feed, results, client, partial(call, function), calls, alone)
        threading.Thread(target=feeder, daemon=True).start()
        last_busy = time.monotonic()
        while True:
            try:
                result = results.get(timeout=POLL_SECONDS)
            except queue.Empty:
                if any(client.processing().values()):
                    last_busy = time.monotonic()
                elif time.monotonic() - last_busy > self._patience:
                    raise RoundBrokenError("the cluster is idle although results are missing") from None
                continue
            last_busy = time.monotonic()
            if result is None:
                return
            if isinstance(result, BaseException):
                raise result
            yield result


def _feed(
    results: queue.SimpleQueue,
    client: Client,
    worker: Callable,
    calls: Iterable[tuple[int, Any]],
    alone: bool,
) -> None:
    """Put the results of the calls into the queue, then None, or the exception that ended them.

    Arguments are plain containers, which joblib sends with the task: what it scattered would be lost with a
    worker.
    """
    from joblib import Parallel, delayed, parallel_config
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):
        """Never of one job: joblib would run it here, as when but one worker is left, and die with it."""

        def effective_n_jobs(self, n_jobs: int) -> int:
            return max(2, super().effective_n_jobs(n_jobs))

    try:
        with parallel_config(Backend(client=client)):
            parallel = Parallel(
                return_as="generator_unordered", batch_size=1, pre_dispatch="1" if alone else "2*n_jobs"
            )
            for result in parallel(delayed(worker)(index, task) for index, task in calls):
                results.put(result)
        results.put(None)
    except BaseException as error:
        results.put(error)
