"""Trials in an MLflow store: one run each."""

from __future__ import annotations

import shlex
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.config import ConfigError
from simbias.interfaces import TrackedSweep, TrackedTrial, Tracking
from simbias.records import Array, Iteration, Rollout
from simbias.tracking import fields, files, notes, pages
from simbias.tracking.store import cause, connect, exists, locked

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from pandas import DataFrame

    from simbias.study import Study
    from simbias.sweep.grid import Sweep

NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
PICTURES = "pictures"  # folder of the artifacts
BATCH = 100  # parameters that MLflow takes at once
METRICS = 1000  # metrics that MLflow takes at once
UI = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false mlflow ui --workers 1"  # a fifth of the memory, and sooner up


class Mlflow(Tracking):
    """A store of MLflow's.

    Parameters
    ----------
    uri
        Any MLflow tracking URI. The files of a SQLite store lie in `mlartifacts` beside the database.
    experiment
        MLflow's experiment, which holds the runs; it is created if need be.
    pictures
        Whether each trial's pictures are drawn and kept; those of a sweep's trials are fewer.
    """

    def __init__(
        self, uri: str = "sqlite:///mlflow.db", experiment: str = "simbias", pictures: bool = True
    ) -> None:
        self._uri = uri
        self._experiment = experiment
        self.pictures = pictures

    def open(self, study: Study) -> TrackedTrial:
        """Begin a run: config, tags and a note of what runs. The first trial in a SQLite store creates it.

        Processes that share a new SQLite store must wait for the first: creation by several at once fails.

        Raises
        ------
        ConfigError
            Within seconds, if the store cannot be used.
        """
        client, experiment_id = connect(self._uri, self._experiment)
        run = client.create_run(experiment_id, run_name=notes.run_name(study), tags=fields.tags(study))
        run_id = run.info.run_id
        return MlflowTrial(client, run_id, study, self._where(experiment_id, run_id))

    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin a parent run, or go on with the one that an earlier process began.

        Raises
        ------
        ConfigError
            Within seconds, if the store cannot be used, or another process runs this sweep into it.
        """
        from simbias.tracking.mlflow_sweep import MlflowSweep

        client, experiment_id = connect(self._uri, self._experiment)
        lock = locked(self._uri, f"{experiment_id} {sweep.hash}")
        try:
            return MlflowSweep(client, experiment_id, sweep, again, self._where, lock)
        except Exception as error:
            lock.close()
            raise ConfigError("tracking.uri", f"{fields.shown(self._uri)}: {cause(error)}") from error

    def finished(self, sweep: Sweep) -> DataFrame:
        """The finished trials of a sweep; a store that is not there is not made."""
        from simbias.tracking import results

        if not exists(self._uri):
            return results.frame([], sweep)
        client, experiment_id = connect(self._uri, self._experiment)
        parent = results.find_sweep(client, experiment_id, sweep)
        if parent is None:
            return results.frame([], sweep)
        trials = results.of_sweep(client, experiment_id, parent.info.run_id, sweep)
        return trials[trials["outcome"] != "error"]

    def _where(self, experiment_id: str, run_id: str) -> str:
        """How to look at a run: a command and an address."""
        page = "/" + pages.run_page(experiment_id, run_id)
        uri = fields.shown(self._uri)
        if uri.startswith(("http://", "https://")):
            return uri.rstrip("/") + page
        return f"{UI} --backend-store-uri {shlex.quote(uri)}  # http://127.0.0.1:5000{page}"


def experiment_name(iteration: int, experiment: int) -> str:
    """The file of a hardware experiment."""
    return f"experiments/iteration_{iteration:02d}_experiment_{experiment}.npz"


def policy_name(iteration: int) -> str:
    """The file of an iteration's policy."""
    return f"policies/iteration_{iteration:02d}.json"


def data_name(iteration: int) -> str:
    """The file of the data set D that an iteration ended with."""
    return f"data/iteration_{iteration:02d}.npz"


class MlflowTrial(TrackedTrial):
    """A run that is being written."""

    def __init__(self, client: MlflowClient, run_id: str, study: Study, where: str | None) -> None:
        self.where = where
        self.run_id = run_id
        self._client = client
        self._study = study
        self._rows: list[notes.Row] = []
        self._ended: int | None = None  # ms since the epoch; None: when it is closed
        self._unfinished = 0  # experiments since the last iteration
        try:
            self._begin()
        except BaseException as error:
            self.close(error)
            raise

    def _begin(self) -> None:
        """Write what is known before the first iteration."""
        from mlflow.entities import Param
        from omegaconf import OmegaConf

        parameters = [Param(key, value) for key, value in fields.parameters(self._study).items()]
        for start in range(0, len(parameters), BATCH):
            self._client.log_batch(self.run_id, params=parameters[start : start + BATCH])
        config = OmegaConf.to_yaml(OmegaConf.create(fields.shown_config(self._study.config)))
        self._client.log_text(self.run_id, config, "config.yaml")
        self._note(notes.running(self._rows))

    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """Keep a hardware experiment as experiments/iteration_<i>_experiment_<j>.npz."""
        name = experiment_name(iteration, experiment)
        self._keep(name, lambda path: files.save_rollout(path, theta, rollout))
        self._unfinished += 1

    def log(self, iteration: Iteration) -> None:
        """Keep an iteration: policy, data set, note, then its metrics; who finds these finds all."""
        self._rows.append(notes.row(iteration))
        self._unfinished = 0
        for name, write in self._files(iteration):
            self._keep(name, write)
        self._note(notes.running(self._rows))
        self._log_metrics([(iteration, time.time())])

    def illustrate(self, pictures: Mapping[str, bytes]) -> None:
        """Keep pictures in pictures/."""
        with tempfile.TemporaryDirectory() as folder:
            for name, content in pictures.items():
                Path(folder, name).write_bytes(content)
            self._client.log_artifacts(self.run_id, folder, PICTURES)

    def keep(
        self, iterations: Sequence[Iteration], pictures: Mapping[str, bytes], started: float, ended: float
    ) -> None:
        """Keep a trial that ran elsewhere, as the other methods would have, but all at once.

        Times are in s since the epoch.
        """
        self._ended = int(1000 * ended)
        self._rows.extend(map(notes.row, iterations))
        timed = []
        with tempfile.TemporaryDirectory() as folder:
            for iteration in iterations:
                started += sum(iteration.seconds.values())
                timed.append((iteration, min(started, ended)))
                for name, write in (*self._experiment_files(iteration), *self._files(iteration)):
                    path = Path(folder, name)
                    path.parent.mkdir(exist_ok=True)
                    write(path)
            for name, content in pictures.items():
                path = Path(folder, PICTURES, name)
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(content)
            if iterations:
                self._client.log_artifacts(self.run_id, folder)
        self._log_metrics(timed)

    def _files(self, iteration: Iteration) -> Iterator[tuple[str, Callable[[Path], object]]]:
        """Names of an iteration's files and what writes them."""
        policy = files.policy_text(self._study.policy, iteration)
        yield policy_name(iteration.index), lambda path: path.write_text(policy)
        save = partial(files.save_transitions, transitions=iteration.data, task=self._study.task)
        yield data_name(iteration.index), save

    def _experiment_files(self, iteration: Iteration) -> Iterator[tuple[str, Callable[[Path], object]]]:
        """Names of the files of an iteration's experiments and what writes them."""
        for index, rollout in enumerate(iteration.experiments):
            write = partial(files.save_rollout, theta=iteration.optimum.parameters, rollout=rollout)
            yield experiment_name(iteration.index, index), write

    def _log_metrics(self, timed: Sequence[tuple[Iteration, float]]) -> None:
        """Log the metrics of iterations that ended at a time (s since the epoch)."""
        from mlflow.entities import Metric

        metrics = [
            Metric(key, value, int(1000 * ended), iteration.index)
            for iteration, ended in timed
            for key, value in fields.metrics(iteration).items()
        ]
        for start in range(0, len(metrics), METRICS):
            self._client.log_batch(self.run_id, metrics=metrics[start : start + METRICS])

    def close(self, error: BaseException | None = None) -> None:
        """End the run: FINISHED, with or without success; KILLED if interrupted; FAILED after an error."""
        outcome = notes.outcome(self._rows, error)
        if error is not None and outcome == "error":
            self._client.log_text(self.run_id, "".join(traceback.format_exception(error)), "error.txt")
        self._note(notes.verdict(self._rows, error, self._unfinished))
        self._client.set_tag(self.run_id, "outcome", outcome)
        status = {"error": "FAILED", "interrupted": "KILLED"}.get(outcome, "FINISHED")
        self._client.set_terminated(self.run_id, status, end_time=self._ended)

    def _note(self, verdict: str) -> None:
        """Write the run's description."""
        self._client.set_tag(self.run_id, NOTE, notes.note(self._study, self._rows, verdict))

    def _keep(self, name: str, write: Callable[[Path], object]) -> None:
        """Keep a file that `write` makes."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, Path(name).name)
            write(path)
            self._client.log_artifact(self.run_id, str(path), str(Path(name).parent))
