"""A sweep in an MLflow store: a parent run, and a nested run for each trial."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock
from pandas import DataFrame

from simbias.core import markdown
from simbias.engine.workplace import temporary_folder
from simbias.mlflow import fields, pages, results
from simbias.mlflow.artifacts import log_text, remove_uploads
from simbias.mlflow.mlflow_trial import NOTE, MlflowTrial
from simbias.mlflow.nested import nested_runs
from simbias.mlflow.rows import RunRow, is_finished
from simbias.sweep import tables
from simbias.sweep.tracking import TrackedSweep
from simbias.trial.journal import remove, remove_empty
from simbias.trial.run import Outcome, TrialRecord

if TYPE_CHECKING:
    from mlflow import MlflowClient

    from simbias.sweep.batches import Outcomes
    from simbias.sweep.grid import Sweep, Trial
    from simbias.trial.run import RecordedTrial
    from simbias.trial.study import Study

CONFIG = "sweep.yaml"  # what all trials share
FIGURES = "figures"  # folder of the parent's artifacts
EXPERIMENTS = f"{FIGURES}/experiments"  # outcomes of batches
MIXED = "simbias: trials of this sweep are from %d kinds of machines, so their last bits may differ: %s"
NOTE_SECONDS = 5.0  # the parent's note is at most so old while trials end,
NOTE_SHARE = 0.02  # unless it would take more than this of the time


class MlflowSweep(TrackedSweep):
    """A parent run that is being written."""

    keeps = True

    def __init__(
        self,
        client: MlflowClient,
        experiment_id: str,
        sweep: Sweep,
        again: str,
        where: Callable[[str, str], str],
        lock: FileLock,
        journals: Path,
        pictures: Sequence[str],
    ) -> None:
        self._client = client
        self._experiment_id = experiment_id
        self._sweep = sweep
        self._again = again
        self._lock = lock  # until the record is closed
        self._journals = journals
        self.pictures = pictures
        self._note_due = 0.0
        self._captions: dict[str, str] = {}  # of figures
        self.run_id = self._begin()
        client.set_experiment_tag(experiment_id, *pages.trials_view(sweep, self.run_id))
        self.where = where(experiment_id, self.run_id)
        runs = nested_runs(client, experiment_id, self.run_id)
        self._unfinished = {run.tags.get("hash", ""): run.run_id for run in runs if not is_finished(run)}
        self._machines = Counter(
            run.tags[fields.MACHINE] for run in runs if is_finished(run) and fields.MACHINE in run.tags
        )
        done = results.of_sweep(runs, sweep)
        self.finished = frozenset(done.loc[done["outcome"] != Outcome.ERROR, "hash"])
        self.changed = _changed(sweep, [run for run in runs if run.tags.get("hash") in self.finished])
        self._rows: dict[str, Mapping[Any, Any]] = {row["hash"]: row for row in done.to_dict("records")}
        for journal in journals.glob("*"):
            if journal.name in self.finished:  # who kept the trial was killed before it removed this
                remove(journal)
        self._note("**Running**")

    def _begin(self) -> str:
        """The parent run: that of an earlier process, or a new one."""
        parent = results.find_sweep(self._client, self._experiment_id, self._sweep)
        if parent is not None:
            remove_uploads(parent)
            self._client.update_run(parent.info.run_id, status="RUNNING")
        else:
            tags = {**fields.origin(), "hash": self._sweep.hash, "sweep": self._sweep.name}
            name = f"sweep {self._sweep.name}"
            parent = self._client.create_run(self._experiment_id, run_name=name, tags=tags)
        run_id = parent.info.run_id
        if not self._has(run_id, CONFIG):  # an earlier process may have been killed before it wrote it
            config = fields.config_yaml(self._sweep.base.config)
            log_text(self._client, run_id, config, CONFIG)
        return run_id

    def _has(self, run_id: str, name: str) -> bool:
        """Whether a file is among those of a run."""
        return any(file.path == name for file in self._client.list_artifacts(run_id))

    def journal(self, trial: Trial) -> Path:
        """The folder beside the store in which a worker keeps a trial."""
        return self._journals / trial.hash

    def keep(self, trial: Trial, study: Study, record: TrialRecord) -> None:
        """Keep all of a trial in a nested run, whose state becomes FINISHED, or FAILED, last.

        The trial's journal is needed no longer once its run is FINISHED.
        """
        self._rows.pop(trial.hash, None)  # of an attempt that raised
        if trial.hash in self._unfinished:
            run = self._client.get_run(self._unfinished[trial.hash])
        else:
            axes = zip(self._sweep.axes, trial.cell.labels, strict=True)
            tags = {
                **fields.tags(study.composition),
                fields.PARENT: self.run_id,
                "repetition": str(trial.repetition),
                **{fields.AXIS + axis.name: label for axis, label in axes},
            }
            started = int(1000 * record.started)
            run = self._client.create_run(
                self._experiment_id, start_time=started, tags=tags, run_name=trial.name
            )
        kept = MlflowTrial(self._client, run, study, self.where, self.journal(trial))
        kept.keep(record)
        if record.outcome.final:
            remove(self.journal(trial))
            self._note_machine(record)
        if record.outcome in results.TOLD:
            numbers = fields.trial_metrics(kept.whole(record))
            self._rows[trial.hash] = results.row(
                trial,
                self._sweep,
                record.outcome,
                numbers,
                record.reason,
                run.info.run_id,
                fields.holds(record),
            )
        if time.monotonic() > self._note_due:
            self._note("**Running**")

    def _note_machine(self, record: TrialRecord) -> None:
        """Count what trials ran on; say so when another kind of machine comes in."""
        kind = fields.machine_tags(record).get(fields.MACHINE)
        if kind is None:
            return
        mixed = bool(self._machines) and kind not in self._machines
        self._machines[kind] += 1
        if mixed:
            logging.getLogger(__name__).warning(MIXED, len(self._machines), self._kinds())

    def _kinds(self) -> str:
        """What trials ran on."""
        return "; ".join(f"{count} on {kind}" for kind, count in self._machines.items())

    def results(self) -> DataFrame:
        """The trials that are in the store: nobody else writes them while this sweep runs."""
        return results.in_order(self._rows, self._sweep)

    def load(self, run_id: str) -> RecordedTrial:
        """A trial, read back."""
        from simbias.mlflow.trials import load_trial

        allowed = {name for cell in self._sweep.cells for name in cell.composition.allowed}
        return load_trial(run_id, self._client.tracking_uri, allow=sorted(allowed))

    def keep_outcomes(self, batch: str, outcomes: Outcomes) -> None:
        """Keep outcomes as figures/experiments/<batch>.json."""
        log_text(self._client, self.run_id, outcomes.as_json(), f"{EXPERIMENTS}/{batch}.json")

    def outcomes(self, batches: Sequence[str]) -> dict[str, Outcomes]:
        """The outcomes that are in the store; what a killed process left half written is not."""
        from simbias.sweep.batches import Outcomes

        wanted = {f"{EXPERIMENTS}/{batch}.json": batch for batch in batches}
        kept = {}
        with temporary_folder() as folder:
            for file in self._client.list_artifacts(self.run_id, EXPERIMENTS) if wanted else []:
                if file.path in wanted:
                    path = self._client.download_artifacts(self.run_id, file.path, folder)
                    with suppress(ValueError):
                        kept[wanted[file.path]] = Outcomes.from_json(Path(path).read_text())
        return kept

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Keep a figure's files in figures/, and its caption in the note."""
        self._captions[name] = caption
        for file in files:
            self._client.log_artifact(self.run_id, str(file), FIGURES)

    def close(self, error: BaseException | None = None) -> None:
        """End the parent run: FINISHED, KILLED if interrupted, FAILED after an error, here or in a trial."""
        try:
            trials = self.results()
            log_text(self._client, self.run_id, results.rows(trials), "trials.csv")
            self._write(tables.cells(trials, self._sweep))
            for name, value in fields.sweep_metrics(trials).items():
                self._client.log_metric(self.run_id, name, value, step=len(trials))
            status, words = _ending(error, raised="error" in set(trials["outcome"]))
            self._note(words)
            self._client.set_terminated(self.run_id, status)
        except Exception:
            if error is None:
                raise  # else what ended the sweep, as a full disk, may well end this too
        finally:
            self._unlock()

    def _unlock(self) -> None:
        """Let another process go on with the sweep; leave no empty folder."""
        Path(self._lock.lock_file).unlink(missing_ok=True)
        self._lock.release()
        remove_empty(self._journals)

    def _write(self, table: DataFrame) -> None:
        """The table, as markdown, CSV and MLflow's own kind."""
        client = self._client
        names = [axis.name for axis in self._sweep.axes]
        arrangement = tables.layout(table, self._sweep)
        log_text(client, self.run_id, tables.markdown(arrangement), "table.md")
        log_text(client, self.run_id, table.to_csv(index=False), "table.csv")
        if self._has(self.run_id, "table.json"):
            log_text(client, self.run_id, table.to_json(orient="split", index=False), "table.json")
        else:  # what is there, log_table would extend
            client.log_table(self.run_id, table.astype(dict.fromkeys(names, object)), "table.json")

    def _note(self, verdict: str) -> None:
        """Write the parent's description: how far it is, the table, how to go on."""
        began = time.monotonic()
        trials = self.results()
        arrangement = tables.layout(tables.cells(trials, self._sweep), self._sweep)
        link = pages.trials_page(self._experiment_id, self._sweep)
        done = f"{verdict}: {len(trials)} of {len(self._sweep.trials)} [trials]({link})."
        captions = [
            f"[{name}]({self._picture(name)}): {markdown.text(caption)}"
            for name, caption in self._captions.items()
        ]
        mixed = [f"Trials are from several kinds of machines: {markdown.text(self._kinds())}."]
        parts = [
            done,
            *(mixed if len(self._machines) > 1 else []),
            tables.markdown(arrangement),
            tables.legend(self._sweep, trials),
            *captions,
            markdown.code(self._again),
        ]
        self._client.set_tag(self.run_id, NOTE, "\n\n".join(parts))
        ended = time.monotonic()
        self._note_due = ended + max(NOTE_SECONDS, (ended - began) / NOTE_SHARE)

    def _picture(self, name: str) -> str:
        """Address of a figure in MLflow's UI."""
        return pages.run_page(self._experiment_id, self.run_id, f"{FIGURES}/{name}.png")


def _changed(sweep: Sweep, finished: Sequence[RunRow]) -> str:
    """What to say if code of the user's has changed since trials were finished."""
    compositions = {trial.hash: trial.composition for trial in sweep.trials}
    changed = [
        words for run in finished if (words := fields.changed_code(run.tags, compositions[run.tags["hash"]]))
    ]
    if not changed:
        return ""
    return (
        f"{len(changed)} of {len(finished)} finished trials ran on code that has changed since "
        f"({changed[0]}); tracking.experiment=NAME begins anew"
    )


def _ending(error: BaseException | None, raised: bool) -> tuple[str, str]:
    """State and first words of a parent run that ends."""
    if error is None:
        return ("FAILED", "**Ended**, some trials with an error") if raised else ("FINISHED", "**Done**")
    interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
    return ("KILLED", "**Interrupted**") if interrupted else ("FAILED", "**Ended early** by an error")
