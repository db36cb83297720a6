"""A sweep in MLflow, made from its folder and its trials': a parent run, and a nested run for each."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from simbias.core import markdown
from simbias.core.digest import short_digest
from simbias.mlflow import pages
from simbias.mlflow.notes import with_table
from simbias.mlflow.pages import NOTE, RUN_NAME
from simbias.mlflow.runs import Point, RunExport, Runs, readable
from simbias.mlflow.trial import Nested, TrialExport, as_yaml, began_at, origin_tags
from simbias.sweep.folder import CHANGED, FIGURES, SweepFolder
from simbias.sweep.state import DONE, INTERRUPTED, RUNNING, WAITS
from simbias.trial.disk import LOCK, is_locked, require_file
from simbias.trial.folder import TrialFolder

if TYPE_CHECKING:
    from mlflow.entities import Run

TABLE = "table.json"  # among the artifacts
FILES = "files"  # tag: a digest of the other files
STATUS = {RUNNING: "RUNNING", DONE: "FINISHED", INTERRUPTED: "KILLED", WAITS: "SCHEDULED"}


class SweepRun(RunExport):
    """A sweep's run, and a nested run for each of its trials."""

    def __init__(self, runs: Runs, folder: SweepFolder) -> None:
        super().__init__(runs, folder.path)
        self._folder = folder
        self._known: dict[str, list[Run]] = {}  # runs of earlier exports by their trials' hash
        self._exports: dict[str, TrialExport] = {}  # exports of this process by their trials' hash
        self._done: set[str] = set()  # completely exported trials
        self.shown: list[bool] = []  # whether each existing trial was exported, in the last export

    @cached_property
    def _description(self) -> dict[str, Any]:
        """The content of sweep.json."""
        return self._folder.description()

    def trial_ended(self, folder: Path) -> None:
        """Export a trial into a nested run."""
        self.runs.reach(lambda: self._write_ended(TrialFolder(folder)))

    def write(self, final: bool = False) -> None:
        """Write what the run lacks and, at the end, all trials that the store lacks."""
        state = self._folder.state()
        with self.runs.writing(self.path):
            self._run()
        paths = [self._folder.trials / identity for identity in self._description["trials"] if final]
        there = [TrialFolder(path) for path in paths if path.exists()]
        self.shown = [readable(partial(self._write_trial, folder)) for folder in there]
        with self.runs.writing(self.path):
            self._write(state, final)

    def _write(self, state: dict[str, Any], final: bool) -> None:
        """Write what the parent lacks, while no other process does."""
        run = self._run()
        tables = self._folder.tables() if final else []
        own = (*self._folder.figures(), *tables)
        files: dict[str, Path | bytes] = {file.relative_to(self.path).as_posix(): file for file in own}
        files["sweep.yaml"] = as_yaml(self._description["config"])
        points = [*self._points(run, state)] if final and state else []
        tags = {NOTE: self._note(state, final and self._folder.changed())}
        if final:  # file sizes do not reveal changed numbers
            contents = (each if isinstance(each, bytes) else each.read_bytes() for each in files.values())
            tags[FILES] = short_digest(b"".join(contents))
        again = final and run.data.tags.get(FILES) != tags[FILES]
        self.bring(run, files, tags, {}, points, again)
        if tables:
            self._write_table()
        status = STATUS.get(state.get("verdict", RUNNING), "FAILED")
        self.runs.end(run, status if status != "RUNNING" or is_locked(self.path / LOCK) else "KILLED")

    def _points(self, run: Run, state: dict[str, Any]) -> Iterator[Point]:
        """The sweep's numbers that differ from the run's; MLflow shows those of the last step."""
        for name, value in _metrics(state).items():
            known = run.data.metrics.get(name, math.nan)
            if known != value and not (math.isnan(known) and math.isnan(value)):
                history = self.runs.client.get_metric_history(run.info.run_id, name)
                yield name, value, 1 + max((point.step for point in history), default=-1), time.time()

    def _run(self) -> Run:
        """The folder's run, created if necessary; its trials are listed by the sweep's axes.

        The same sweep, started in another folder, has another run.
        """
        about, runs = self._description, self.runs
        if self.run_id and (run := runs.client.get_run(self.run_id)).info.lifecycle_stage == "active":
            return run
        self._uploaded, self._exports, self._done = None, {}, set()
        started = about.get("started")  # None in earlier folders
        start = None if started is None else int(1000 * started)
        found = [each for each in runs.find(about["hash"]) if start in (None, each.info.start_time)]
        tags = {**origin_tags(about), "hash": about["hash"], "sweep": about["name"]}
        run = found[-1] if found else runs.create(f"sweep {about['name']}", tags, start)
        self._known = runs.nested(run.info.run_id)
        for identity, known in self._known.items():
            for each in known:
                if identity in about["trials"]:
                    self._relabel(each, about["trials"][identity])
                else:
                    self._drop(each)
        runs.client.set_experiment_tag(runs.experiment_id, *pages.trials_view(about, run.info.run_id))
        self.run_id = run.info.run_id
        return run

    def _relabel(self, run: Run, about: dict[str, Any]) -> None:
        """Update a trial's position in a run of an earlier export."""
        for key, value in {RUN_NAME: about["name"], **_place(about)}.items():
            if run.data.tags.get(key) != value:
                self.runs.client.set_tag(run.info.run_id, key, value)

    def _drop(self, run: Run) -> None:
        """Take the run of a trial that the sweep has dropped out of it; it may return."""
        client, run_id = self.runs.client, run.info.run_id
        client.set_tag(run_id, pages.DROPPED, self._description["hash"])
        client.set_tag(run_id, RUN_NAME, f"dropped by {self._description['name']}: {run.info.run_name}")
        for key in run.data.tags:
            if key in (pages.PARENT, "repetition") or key.startswith(pages.AXIS):
                client.delete_tag(run_id, key)

    def _write_ended(self, folder: TrialFolder) -> None:
        """Write a trial that has just ended; the store may have been unreachable until then."""
        if not self.run_id:
            with self.runs.writing(self.path):
                self._run()
        self._write_trial(folder)

    def _write_trial(self, folder: TrialFolder) -> None:
        """Update a nested run, unless it is complete."""
        identity, ended = folder.path.name, folder.ended
        known, begun = self._known.get(identity, []), began_at(folder)[-1:]
        whole = ended and ("FINISHED", begun) in [(run.info.status, [run.info.start_time]) for run in known]
        if identity not in self._done and not whole:
            if identity not in self._exports:
                about = self._description["trials"][identity]
                nested = Nested(self.run_id, about["name"], _place(about), known)
                self._exports[identity] = TrialExport(self.runs, folder.path, nested)
            self._exports[identity].write()
        if ended:
            self._done.add(identity)

    def _write_table(self) -> None:
        """Write the table that MLflow displays; `log_table` would append to that of an earlier export."""
        client, labels = self.runs.client, {axis["name"]: str for axis in self._description["axes"]}
        file = require_file(self.path / "table.csv")
        table = pd.read_csv(file, dtype=labels, keep_default_na=False, na_values=[""]).astype(object)
        if any(file.path == TABLE for file in client.list_artifacts(self.run_id)):
            client.log_text(self.run_id, table.to_json(orient="split", index=False), TABLE)
        else:
            client.log_table(self.run_id, table, TABLE)

    def _note(self, state: dict[str, Any], changed: bool) -> str:
        """The parent's description: progress, figures, how to resume, and as much of the table as fits."""
        about = self._description
        link = pages.list_page(self.runs.experiment_id, self.run_id)
        captions = []
        for name, caption in state.get("captions", {}).items():
            page = pages.run_page(self.runs.experiment_id, self.run_id, f"{FIGURES}/{name}.png")
            captions.append(f"[{name}]({page}): {markdown.text(caption)}")
        mixed = state.get("platforms")
        parts = [
            f"{state.get('verdict')}: {state.get('done', 0)} of {len(about['trials'])} [trials]({link}).",
            *([CHANGED] if changed else []),
            *([f"Trials are from several platforms: {markdown.text(mixed)}."] if mixed else []),
            state.get("legend", ""),
            *captions,
            markdown.code(about["command"]),
        ]
        return with_table("\n\n".join(parts), state.get("table", ""))


def _place(about: dict[str, Any]) -> dict[str, str]:
    """A trial's position in the sweep, as tags."""
    labels = {pages.AXIS + name: label for name, label in about["labels"].items()}
    return {"repetition": str(about["repetition"]), **labels}


def _metrics(state: dict[str, Any]) -> dict[str, float]:
    """A sweep in numbers."""
    outcomes = state["outcomes"]
    names = ("succeeded", "not succeeded", "error")
    counts = {f"trials/{name.replace(' ', '_')}": float(outcomes.get(name, 0)) for name in names}
    mean = state["mean_experiments"]
    return {**counts, "experiments/mean": math.nan if mean is None else mean}
