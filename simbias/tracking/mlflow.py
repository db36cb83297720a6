"""Trials in an MLflow store: one run each."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.commands import python
from simbias.config.errors import ConfigError
from simbias.engine import workplace
from simbias.records import Iteration, Rollout
from simbias.tracking import fields, files, notes, pages
from simbias.tracking.artifacts import remove_file, remove_uploads
from simbias.tracking.contract import TrackedSweep, TrackedTrial, Tracking
from simbias.tracking.journal import ERROR, Journal, acquire, refusals, remove
from simbias.tracking.rows import FINISHED, is_finished, row_of
from simbias.tracking.store import connect, database, exists, reaching
from simbias.trial import Outcome, TrialRecord

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run
    from pandas import DataFrame

    from simbias.study import Study
    from simbias.sweep.grid import Sweep
    from simbias.tracking.trials import RecordedTrial

NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
PICTURES = "pictures"  # folder of the artifacts
REFUSED = "refused"  # likewise: what hardware returned that was no rollout
PICTURES_SECONDS = 60.0  # in which one picture of a trial that has ended is copied
BATCH = 100  # parameters that MLflow takes at once
METRICS = 800  # metrics at once: MLflow takes 1000 of metrics, parameters and tags
SPARING = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"  # a fifth of the memory, and sooner up
ITERATIONS = "experiments/iterations"  # the metric that tells how many iterations are kept
_Metric = tuple[str, float, int, float]  # name, value, step, s since the epoch
STATUS = {Outcome.ERROR: "FAILED", Outcome.INTERRUPTED: "KILLED", Outcome.WAITING: "SCHEDULED"}


class Mlflow(Tracking):
    """A store of MLflow's, and journals of the trials under way.

    Parameters
    ----------
    uri
        Any MLflow tracking URI. The files of a SQLite store lie in `mlartifacts` beside the database.
    experiment
        MLflow's experiment, which holds the runs; it is created if need be.
    pictures
        Whether each trial's pictures are drawn and kept; those of a sweep's trials are fewer.
    journals
        Folder for the journals of trials that have not come to their end; None is `journals` beside a SQLite
        store's database, else in the working folder.
    """

    def __init__(
        self,
        uri: str = "sqlite:///mlflow.db",
        experiment: str = "simbias",
        pictures: bool = True,
        journals: str | None = None,
    ) -> None:
        self._uri = uri
        self._experiment = experiment
        self._pictures = pictures
        self._journals = journals

    def open(self, study: Study) -> TrackedTrial:
        """Begin a run, or go on with the one that the trial began; what came to its end stays as it is.

        Processes that share a new SQLite store must wait for the first: creation by several at once fails.
        """
        from simbias.pictures.trial.gallery import ALL

        workplace.tidy()
        client, experiment_id = connect(self._uri, self._experiment)
        with reaching(self._uri):
            return self._opened(client, experiment_id, study, ALL if self._pictures else ())

    def _opened(
        self, client: MlflowClient, experiment_id: str, study: Study, pictures: Sequence[str]
    ) -> TrackedTrial:
        """A trial's run, new or an earlier one."""
        before = _earlier(client, experiment_id, study.hash)
        folder = self._folder() / study.hash
        if before is not None and is_finished(row_of(before)):
            remove(folder)  # who ended the trial may have been killed before it did
            remove_uploads(before, PICTURES_SECONDS)
            run_id = before.info.run_id
            where = self._where(experiment_id, run_id)
            return FinishedTrial(self._uri, run_id, where, study.composition.allowed)
        journal = Journal(folder, pictures)
        try:
            if before is None:
                name, tags = notes.run_name(study), fields.tags(study.composition)
                before = client.create_run(experiment_id, run_name=name, tags=tags)
            where = self._where(experiment_id, before.info.run_id)
            return MlflowTrial(client, before, study, where, folder, journal)
        except BaseException:
            journal.release()
            raise

    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin a parent run, or go on with the one that an earlier process began."""
        from simbias.pictures.trial.gallery import IN_SWEEPS
        from simbias.tracking.mlflow_sweep import MlflowSweep

        workplace.tidy()
        client, experiment_id = connect(self._uri, self._experiment)
        folder = self._folder()
        taken = ConfigError("sweep", "another process is running this sweep into the same store")
        lock = acquire(folder / f"sweep_{sweep.hash}.lock", 0.0, taken)
        pictures = IN_SWEEPS if self._pictures else ()
        try:
            with reaching(self._uri):
                return MlflowSweep(client, experiment_id, sweep, again, self._where, lock, folder, pictures)
        except BaseException:
            lock.release()
            raise

    def finished(self, sweep: Sweep) -> DataFrame:
        """The finished trials of a sweep; a store that is not there is not made."""
        from simbias.tracking import results
        from simbias.tracking.nested import nested_runs

        if not exists(self._uri):
            return results.frame([], sweep)
        client, experiment_id = connect(self._uri, self._experiment)
        with reaching(self._uri):
            parent = results.find_sweep(client, experiment_id, sweep)
            if parent is None:
                return results.frame([], sweep)
            trials = results.of_sweep(nested_runs(client, experiment_id, parent.info.run_id), sweep)
        return trials[trials["outcome"] != Outcome.ERROR]

    def _folder(self) -> Path:
        """Where the journals of this experiment's trials are."""
        file = database(self._uri)
        root = Path(self._journals) if self._journals else (file.parent if file else Path()) / "journals"
        return root / re.sub(r"[^\w\-.]", "_", self._experiment)

    def _where(self, experiment_id: str, run_id: str) -> str:
        """How to look at a run: a command and an address."""
        page = "/" + pages.run_page(experiment_id, run_id)
        uri = fields.redact(self._uri)
        if uri.startswith(("http://", "https://")):
            return uri.rstrip("/") + page
        ui = f"{SPARING} {python()} -m mlflow ui --workers 1"
        return f"{ui} --backend-store-uri {shlex.quote(uri)}  # http://127.0.0.1:5000{page}"


def _earlier(client: MlflowClient, experiment_id: str, identity: str) -> Run | None:
    """The run of a trial that came to its end, in a sweep or on its own; else the one that it began."""
    runs = client.search_runs([experiment_id], f"tags.hash = '{identity}'", order_by=["created ASC"])
    ended = [run for run in runs if is_finished(row_of(run))]
    own = [run for run in runs if fields.PARENT not in run.data.tags]
    return next(iter([*ended, *own]), None)


class FinishedTrial(TrackedTrial):
    """A trial that came to its end before."""

    def __init__(self, uri: str, run_id: str, where: str, allowed: Sequence[str]) -> None:
        self.where = where
        self.run_id = run_id
        self._uri = uri
        self._allowed = allowed

    def finished(self) -> RecordedTrial:
        """The trial, read back."""
        from simbias.tracking.trials import load_trial

        trial = load_trial(self.run_id, self._uri, allow=self._allowed)
        if not trial.iterations:
            raise ConfigError(self.run_id, "has come to its end, but its iterations are not in the store")
        return trial


@dataclass
class _Pending:
    """What is to be written into a run: few large writes take a fraction of the time of many small ones."""

    files: list[tuple[str, Callable[[Path], object]]] = field(default_factory=list)  # name, what writes it
    parameters: dict[str, str] = field(default_factory=dict)
    metrics: list[list[_Metric]] = field(default_factory=list)  # those of a list are kept together
    tags: dict[str, str] = field(default_factory=dict)


class MlflowTrial(TrackedTrial):
    """A run that is being written."""

    def __init__(
        self,
        client: MlflowClient,
        run: Run,
        study: Study,
        where: str | None,
        folder: Path | None,
        journal: Journal | None = None,
    ) -> None:
        self.where = where
        self.run_id = run.info.run_id
        self.pictures = journal.pictures if journal else ()
        self._client = client
        self._study = study
        self._folder = folder  # of the journal
        self._journal = journal  # if the trial runs here
        self._pending = _Pending()
        self._rows: list[notes.Row] = []
        self._logged = int(run.data.metrics.get(ITERATIONS, 0))
        self._time = self._last_time(run)  # s since the epoch, up to the last iteration
        self._seconds = run.data.metrics.get(fields.SECONDS, 0.0)  # that earlier processes took
        if run.info.status != "RUNNING":  # it was ended early, and goes on
            client.update_run(self.run_id, status="RUNNING")
        remove_uploads(run)
        if "error" in run.data.tags:
            remove_file(run, ERROR)
        for tag in {"error", "outcome"} & run.data.tags.keys():
            client.delete_tag(self.run_id, tag)
        try:
            self._begin(run)
        except Exception:
            client.set_terminated(self.run_id, "FAILED")
            raise

    def _last_time(self, run: Run) -> float:
        """When the last iteration that was kept ended, or the run began: s since the epoch."""
        if not self._logged:
            return (run.info.start_time or 0) / 1000
        history = self._client.get_metric_history(self.run_id, ITERATIONS)
        return max((metric.timestamp for metric in history), default=run.info.start_time or 0) / 1000

    def _begin(self, run: Run) -> None:
        """Write what is known before the first iteration, unless an earlier process did."""
        composition = self._study.composition
        parameters = fields.parameters(composition)
        missing = {key: value for key, value in parameters.items() if key not in run.data.params}
        if len(missing) == len(parameters):
            config = fields.config_yaml(composition.config)
            self._pending.files.append(("config.yaml", partial(_write_text, config)))
        self._pending.parameters |= missing
        if self._journal:  # it begins now, and has not run elsewhere
            self._note(notes.running(self._rows))
            self._flush()

    def recalling(self, study: Study) -> Study:
        """The study, its experiments and searches kept in the journal."""
        return self._journal.recalling(study) if self._journal else study

    def iterated(self, iteration: Iteration) -> None:
        """Keep an iteration, unless an earlier process did."""
        self._write([iteration])
        self._note(notes.running(self._rows))
        self._flush()

    def explained(self, traceback: str) -> str:
        """Keep a traceback in the journal."""
        return self._journal.explained(traceback) if self._journal else ""

    def ended(self, record: TrialRecord) -> None:
        """End the run: FINISHED, with or without success; KILLED if interrupted; FAILED after an error.

        The journal is needed no longer once the run is FINISHED.
        """
        with self._not_running_for_ever():
            self._end(record)
        if self._journal is None:
            return
        if record.outcome.final:
            self._journal.discard()
        else:
            self._journal.ended(record)

    def _end(self, record: TrialRecord) -> None:
        """Write how the trial ended."""
        pending = self._pending
        if record.reason:
            pending.tags["error"] = record.reason
        if record.traceback:
            pending.files.append((ERROR, partial(_write_text, record.traceback)))
        if self._folder:
            pending.files += [
                (f"{REFUSED}/{path.name}", partial(_copy, path)) for path in refusals(self._folder)
            ]
        pending.files += self._experiment_files(len(record.iterations), record.unfinished)
        self._time = record.started + record.seconds
        whole = replace(record, seconds=self._seconds + record.seconds)
        numbers = fields.trial_metrics(whole).items()
        pending.metrics.append([(name, value, 0, self._time) for name, value in numbers])
        self._note(notes.verdict(self._rows, record))
        pending.tags["outcome"] = record.outcome
        self._flush()
        ended = int(1000 * self._time)
        self._client.set_terminated(self.run_id, STATUS.get(record.outcome, FINISHED), end_time=ended)

    def illustrated(self, pictures: Mapping[str, bytes]) -> None:
        """Keep pictures in pictures/."""
        self._illustrate(pictures)
        self._flush()

    def keep(self, record: TrialRecord) -> None:
        """Keep a trial that ran elsewhere, all at once."""
        with self._not_running_for_ever():
            self._write(record.iterations)
            self._illustrate(record.pictures)
            self._end(record)

    @contextmanager
    def _not_running_for_ever(self) -> Iterator[None]:
        """A run that cannot be ended as it should is FAILED, and its trial free for another process."""
        try:
            yield
        except Exception:
            with suppress(Exception):  # the store may be out of reach
                self._client.set_terminated(self.run_id, STATUS[Outcome.ERROR])
            if self._journal:
                self._journal.release()
            raise

    def _illustrate(self, pictures: Mapping[str, bytes]) -> None:
        """Keep pictures when all is written."""
        for name, content in pictures.items():
            self._pending.files.append((f"{PICTURES}/{name}", partial(_write_bytes, content)))

    def _write(self, iterations: Sequence[Iteration]) -> None:
        """Keep iterations when all is written, unless an earlier process did."""
        self._rows.extend(notes.row(self._study, iteration) for iteration in iterations)
        for iteration in iterations:
            if iteration.index < self._logged:
                continue
            self._time += sum(iteration.seconds.values())
            own = [(*each, iteration.index, self._time) for each in fields.metrics(iteration).items()]
            self._pending.files += self._files(iteration)
            self._pending.metrics.append(own)

    def _files(self, iteration: Iteration) -> Iterator[tuple[str, Callable[[Path], object]]]:
        """Names of an iteration's files and what writes them."""
        yield from self._experiment_files(iteration.index, iteration.experiments)
        policy = files.policy_text(self._study.policy, iteration)
        yield files.policy_name(iteration.index), lambda path: path.write_text(policy)
        if iteration.search is not None and iteration.search.estimates:
            estimates = files.parameters_text(iteration.search.estimates)
            yield files.parameters_name(iteration.index), lambda path: path.write_text(estimates)
        if iteration.learning is not None:
            data = iteration.learning.data
            save = partial(files.save_transitions, transitions=data, task=self._study.task)
            yield files.data_name(iteration.index), save

    def _experiment_files(
        self, index: int, experiments: Sequence[Rollout]
    ) -> Iterator[tuple[str, Callable[[Path], object]]]:
        """Names of the files of an iteration's experiments and what writes them."""
        for number, rollout in enumerate(experiments):
            yield files.experiment_name(index, number), partial(files.save_rollout, rollout=rollout)

    def _note(self, verdict: str) -> None:
        """Keep the run's description when all is written."""
        self._pending.tags[NOTE] = notes.note(self._study, self._rows, verdict)

    def _flush(self) -> None:
        """Write all that is pending: files first, so that who finds metrics finds all."""
        from mlflow.entities import Metric, Param, RunTag

        pending, self._pending = self._pending, _Pending()
        self._keep(pending.files)
        parameters = [Param(key, value) for key, value in pending.parameters.items()]
        for start in range(BATCH, len(parameters), BATCH):
            self._client.log_batch(self.run_id, params=parameters[start : start + BATCH])
        metrics = [
            [Metric(name, value, int(1000 * time), step) for name, value, step, time in batch]
            for batch in _batches(pending.metrics)
        ]
        for batch in metrics[:-1]:
            self._client.log_batch(self.run_id, metrics=batch)
        tags = [RunTag(key, value) for key, value in pending.tags.items()]
        self._client.log_batch(self.run_id, metrics=metrics[-1], params=parameters[:BATCH], tags=tags)

    def _keep(self, named: Sequence[tuple[str, Callable[[Path], object]]]) -> None:
        """Keep files, by their names and what writes them."""
        if not named:
            return
        with workplace.temporary_folder() as folder:
            for name, write in named:
                path = Path(folder, name)
                path.parent.mkdir(exist_ok=True)
                write(path)
            self._client.log_artifacts(self.run_id, folder)


def _batches(lists: Sequence[Sequence[_Metric]]) -> list[list[_Metric]]:
    """Lists of metrics, put together as far as MLflow takes them at once; those of a list stay together."""
    batches: list[list[_Metric]] = [[]]
    for metrics in lists:
        for start in range(0, len(metrics), METRICS):
            part = metrics[start : start + METRICS]
            if len(batches[-1]) + len(part) > METRICS:
                batches.append([])
            batches[-1] += part
    return batches


def _write_text(text: str, path: Path) -> None:
    """Write a file."""
    path.write_text(text)


def _copy(source: Path, path: Path) -> None:
    """Copy a file."""
    shutil.copyfile(source, path)


def _write_bytes(content: bytes, path: Path) -> None:
    """Write a file."""
    path.write_bytes(content)
