"""Trials in an MLflow store: one run each."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core.commands import python
from simbias.core.errors import ConfigError
from simbias.engine import workplace
from simbias.mlflow import fields, notes, pages
from simbias.mlflow.artifacts import remove_uploads
from simbias.mlflow.mlflow_trial import MlflowTrial
from simbias.mlflow.rows import is_finished, row_of
from simbias.mlflow.store import connect, database, exists, reaching
from simbias.sweep.tracking import TrackedSweep, TrackedTrial, Tracking
from simbias.trial.journal import Journal, acquire, remove
from simbias.trial.run import Outcome

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run
    from pandas import DataFrame

    from simbias.sweep.grid import Sweep
    from simbias.trial.run import RecordedTrial
    from simbias.trial.study import Study

PICTURES_SECONDS = 60.0  # in which one picture of a trial that has ended is copied
SPARING = "MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false"  # a fifth of the memory, and sooner up


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
        if not experiment.isprintable() or set(experiment.strip()) <= {"."}:
            raise ValueError("experiment must be a name that can be printed, and no dots alone")
        self._uri = uri
        self._experiment = experiment
        self._pictures = pictures
        self._journals = journals

    def open(self, study: Study) -> TrackedTrial:
        """Begin a run, or go on with the one that the trial began; what came to its end stays as it is.

        Processes may share a new SQLite store: one makes it, the others find it.
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
            finished = FinishedTrial(self._uri, run_id, where, study.composition.allowed)
            finished.changed = _changed(before, study, "is shown as it was; ")
            return finished
        journal = Journal(folder, pictures)
        try:
            if before is None:
                name, tags = notes.run_name(study), fields.tags(study.composition)
                before = client.create_run(experiment_id, run_name=name, tags=tags)
            where = self._where(experiment_id, before.info.run_id)
            trial = MlflowTrial(client, before, study, where, folder, journal)
            trial.changed = _changed(before, study, "goes on, but ")
            return trial
        except BaseException:
            journal.release()
            raise

    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin a parent run, or go on with the one that an earlier process began."""
        from simbias.mlflow.mlflow_sweep import MlflowSweep
        from simbias.pictures.trial.gallery import IN_SWEEPS

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
        """The finished trials of a sweep; a store that is not there is not made.

        That all are is read from a SQLite store without MLflow, which takes two seconds: it is opened next. A
        dry run, which does not open it, tries whether it can be used.
        """
        from simbias.mlflow import results
        from simbias.mlflow.nested import nested_runs, runs_of_sweep

        if not exists(self._uri):
            return results.frame([], sweep)
        if not sweep.dry_run and (file := database(self._uri)) is not None:
            trials = results.of_sweep(runs_of_sweep(file, self._experiment, sweep.hash), sweep)
            if len(trials) == len(sweep.trials) and not (trials["outcome"] == Outcome.ERROR).any():
                return trials
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


def _changed(run: Run, study: Study, what: str) -> str:
    """What to say if code of the user's has changed since a run began."""
    changed = fields.changed_code(run.data.tags, study.composition)
    if not changed:
        return ""
    return f"the trial {what}its code has changed since it began ({changed}); seed=N makes a new one"


class FinishedTrial(TrackedTrial):
    """A trial that came to its end before."""

    def __init__(self, uri: str, run_id: str, where: str, allowed: Sequence[str]) -> None:
        self.where = where
        self.run_id = run_id
        self._uri = uri
        self._allowed = allowed

    def finished(self) -> RecordedTrial:
        """The trial, read back."""
        from simbias.mlflow.trials import load_trial

        trial = load_trial(self.run_id, self._uri, allow=self._allowed)
        if not trial.iterations:
            raise ConfigError(self.run_id, "has come to its end, but its iterations are not in the store")
        return trial
