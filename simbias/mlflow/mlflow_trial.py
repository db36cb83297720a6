"""A trial's run in an MLflow store, while it is written."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.core.records import Iteration, Rollout
from simbias.mlflow import fields, notes
from simbias.mlflow.artifacts import remove_file, remove_uploads
from simbias.mlflow.rows import FINISHED
from simbias.mlflow.writes import File, Writes
from simbias.sweep.tracking import TrackedTrial
from simbias.trial import files
from simbias.trial.journal import ERROR, Journal, refusals
from simbias.trial.run import Outcome, TrialRecord

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

    from simbias.trial.study import Study

NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
PICTURES = "pictures"  # folder of the artifacts
REFUSED = "refused"  # likewise: what hardware returned that was no rollout
ITERATIONS = "experiments/iterations"  # the metric that tells how many iterations are kept
STATUS = {Outcome.ERROR: "FAILED", Outcome.INTERRUPTED: "KILLED", Outcome.WAITING: "SCHEDULED"}


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
        self._writes = Writes()
        self._rows: list[notes.Row] = []
        self._iterations: list[Iteration] = []  # of the rows
        self._before = run.data.metrics  # of an earlier process
        self._logged = int(self._before.get(ITERATIONS, 0))
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
            self._writes.files.append(("config.yaml", partial(_write_text, config)))
        self._writes.parameters |= missing
        if self._journal:  # it begins now, and has not run elsewhere
            self._note(notes.running(self._rows))
            self._flush()

    def recalling(self, study: Study) -> Study:
        """The study, its experiments and searches kept in the journal."""
        if self._journal is None:
            return study
        recalled = self._journal.recalling(study)
        self.machines = self._journal.machines
        return recalled

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

    def whole(self, record: TrialRecord) -> TrialRecord:
        """The record, its seconds with those that earlier processes took."""
        return replace(record, seconds=self._seconds + record.seconds)

    def _end(self, record: TrialRecord) -> None:
        """Write how the trial ended."""
        writes = self._writes
        if record.reason:
            writes.tags["error"] = record.reason
        if record.traceback:
            writes.files.append((ERROR, partial(_write_text, record.traceback)))
        if self._folder:
            writes.files += [
                (f"{REFUSED}/{path.name}", partial(_copy, path)) for path in refusals(self._folder)
            ]
        writes.files += self._experiment_files(len(record.iterations), record.unfinished)
        self._time = record.started + record.seconds
        numbers = fields.trial_metrics(self.whole(record)).items()
        new = [(name, value) for name, value in numbers if self._before.get(name) != value]
        writes.metrics.append([(name, value, 0, self._time) for name, value in new])
        self._note(notes.verdict(self._rows, record))
        writes.tags |= {"outcome": record.outcome, **fields.machine_tags(record)}
        if record.held_out:
            writes.tags[fields.HELD_OUT] = fields.holds(record)
            text = files.held_out_text(record.held_out, self._study.task)
            writes.files.append((files.HELD_OUT, partial(_write_text, text)))
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
            self._writes.files.append((f"{PICTURES}/{name}", partial(_write_bytes, content)))

    def _write(self, iterations: Sequence[Iteration]) -> None:
        """Keep iterations when all is written, unless an earlier process did."""
        for iteration in iterations:
            self._rows.append(notes.row(self._study, iteration, self._iterations))
            self._iterations.append(iteration)
            if iteration.index < self._logged:
                continue
            self._time += sum(iteration.seconds.values())
            own = [(*each, iteration.index, self._time) for each in fields.metrics(iteration).items()]
            self._writes.files += self._files(iteration)
            self._writes.metrics.append(own)

    def _files(self, iteration: Iteration) -> Iterator[File]:
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

    def _experiment_files(self, index: int, experiments: Sequence[Rollout]) -> Iterator[File]:
        """Names of the files of an iteration's experiments and what writes them."""
        for number, rollout in enumerate(experiments):
            yield files.experiment_name(index, number), partial(files.save_rollout, rollout=rollout)

    def _note(self, verdict: str) -> None:
        """Keep the run's description when all is written."""
        self._writes.tags[NOTE] = notes.note(self._study, self._rows, verdict)

    def _flush(self) -> None:
        """Write all that is pending."""
        writes, self._writes = self._writes, Writes()
        writes.flush(self._client, self.run_id)


def _write_text(text: str, path: Path) -> None:
    """Write a file."""
    path.write_text(text)


def _copy(source: Path, path: Path) -> None:
    """Copy a file."""
    shutil.copyfile(source, path)


def _write_bytes(content: bytes, path: Path) -> None:
    """Write a file."""
    path.write_bytes(content)
