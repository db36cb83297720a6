"""A sweep in MLflow, made from its folder and its trials': a parent run, and a nested run for each."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from simbias.core import markdown
from simbias.core.errors import ConfigError
from simbias.mlflow import pages
from simbias.mlflow.runs import NOT_EXPORTED, Runs
from simbias.mlflow.trial import NOTE, Nested, TrialExport, began_at, origin_tags, write_yaml
from simbias.sweep.folder import FIGURES, SweepFolder
from simbias.sweep.tracking import Export
from simbias.trial.disk import LOCK, is_locked
from simbias.trial.folder import TrialFolder

if TYPE_CHECKING:
    from mlflow.entities import Run

TABLE = "table.json"  # among the artifacts
STATUS = {"**Running**": "RUNNING", "**Done**": "FINISHED", "**Interrupted**": "KILLED"}


class MlflowSweep(Export):
    """A parent run.

    Parameters
    ----------
    runs
        Where it is, or will be.
    folder
        The sweep's.
    """

    def __init__(self, runs: Runs, folder: SweepFolder) -> None:
        self._runs, self._folder = runs, folder
        self._description = folder.description()
        self._uploaded: dict[str, int | None] = {}  # sizes of files
        self._trials: dict[str, Run] = {}  # runs of earlier exports by their trials' hash
        self._done: set[str] = set()  # trials that nothing is added to
        self._parent = ""  # its run

    @property
    def where(self) -> str:  # type: ignore[override]
        """How a person looks at the run, or at the folder where the store is away."""
        found, identity = self._parent, self._description["hash"]
        return self._runs.address(identity, found) if found else str(self._folder.path)

    def _run(self) -> Run:
        """The parent run, a new one if need be; its trials are listed by the sweep's axes."""
        about, runs = self._description, self._runs
        if self._parent and (run := runs.client.get_run(self._parent)).info.lifecycle_stage == "active":
            return run
        self._uploaded, self._done = {}, set()
        tags = {**origin_tags(about), "hash": about["hash"], "sweep": about["name"]}
        found = runs.find(about["hash"])
        run = found[-1] if found else runs.create(f"sweep {about['name']}", tags)
        self._trials = runs.nested(run.info.run_id) if found else {}
        runs.client.set_experiment_tag(runs.experiment_id, *pages.trials_view(about, run.info.run_id))
        self._parent = run.info.run_id
        return run

    def trial_ended(self, folder: Path) -> None:
        """Export a trial into a nested run."""
        if self._parent:  # else the store is away: `update` will export it
            self._runs.reach(lambda: self._write_trial(TrialFolder(folder)))

    def _write_trial(self, folder: TrialFolder) -> None:
        """Bring a nested run up to date; one that has all of a trial that has ended is left alone."""
        identity, ended = folder.path.name, folder.ended
        known = self._trials.get(identity)
        whole = known and (known.info.status, known.info.start_time) == ("FINISHED", began_at(folder))
        if identity not in self._done and not (ended and whole):
            about = self._description["trials"][identity]
            labels = {pages.AXIS + name: label for name, label in about["labels"].items()}
            tags = {"repetition": str(about["repetition"]), **labels}
            TrialExport(self._runs, folder.path, Nested(self._parent, about["name"], tags, known)).write()
        if ended:
            self._done.add(identity)

    def update(self, final: bool = False) -> None:
        """Bring the parent run up to date, and at the end all trials that the store lacks."""
        self._runs.reach(lambda: self.write(final), final)

    def write(self, final: bool) -> None:
        """Write what the run lacks.

        Raises
        ------
        ConfigError
            If a file cannot be read.
        """
        state, run = self._folder.state(), self._run()
        client, run_id = self._runs.client, run.info.run_id
        if final:
            self._write_trials()
        self._upload(run_id, final)
        verdict = state.get("verdict", "**Running**")
        client.set_tag(run_id, NOTE, self._note(state, run_id))
        for name, value in _metrics(state).items() if final and state else ():
            if run.data.metrics.get(name) != value:
                client.log_metric(run_id, name, value, step=state["done"])
        status = STATUS.get(verdict, "FAILED")
        if status == "RUNNING" and not is_locked(self._folder.path / LOCK):
            status = "KILLED"
        if run.info.status == status:
            return
        if status == "RUNNING":
            client.update_run(run_id, status=status)
        else:
            client.set_terminated(run_id, status)

    def _write_trials(self) -> None:
        """Export all trials that have begun; those that cannot be read are named."""
        for identity in self._description["trials"]:
            try:
                self._write_trial(TrialFolder(self._folder.trials / identity))
            except ConfigError as error:
                logging.getLogger(__name__).warning(NOT_EXPORTED, error)

    def _upload(self, run_id: str, final: bool) -> None:
        """Copy the files that the run lacks; tables at the end."""
        client, own = self._runs.client, self._folder
        if not self._uploaded:
            found = [file for place in (None, FIGURES) for file in client.list_artifacts(run_id, place)]
            self._uploaded = {file.path: file.file_size for file in found if not file.is_dir}
        if "sweep.yaml" not in self._uploaded:
            with tempfile.TemporaryDirectory() as folder:
                write_yaml(self._description["config"], Path(folder, "sweep.yaml"))
                client.log_artifact(run_id, f"{folder}/sweep.yaml")
            self._uploaded["sweep.yaml"] = 0
        files: list[tuple[Path, str | None]] = [(file, FIGURES) for file in own.figures()]
        for file, place in [*files, *((file, None) for file in own.tables() if final)]:
            name = f"{place}/{file.name}" if place else file.name
            if self._uploaded.get(name) != file.stat().st_size or place is None:
                client.log_artifact(run_id, str(file), place)
                self._uploaded[name] = file.stat().st_size
        if final and own.tables():
            self._upload_table(run_id)

    def _upload_table(self, run_id: str) -> None:
        """Write the table that MLflow shows as one; `log_table` would append to that of an earlier export."""
        labels = {axis["name"]: str for axis in self._description["axes"]}
        table = pd.read_csv(self._folder.path / "table.csv", dtype=labels).astype(object)
        if TABLE in self._uploaded:
            self._runs.client.log_text(run_id, table.to_json(orient="split", index=False), TABLE)
        else:
            self._runs.client.log_table(run_id, table, TABLE)
            self._uploaded[TABLE] = 0

    def _note(self, state: dict[str, Any], run_id: str) -> str:
        """The parent's description: how far it is, the table, how to resume."""
        about = self._description
        link = pages.trials_page(self._runs.experiment_id, about["hash"])
        captions = [
            f"[{name}]({self._picture(run_id, name)}): {markdown.text(caption)}"
            for name, caption in state.get("captions", {}).items()
        ]
        mixed = state.get("platforms")
        parts = [
            f"{state.get('verdict')}: {state.get('done', 0)} of {len(about['trials'])} [trials]({link}).",
            *([f"Trials are from several platforms: {markdown.text(mixed)}."] if mixed else []),
            state.get("table", ""),
            state.get("legend", ""),
            *captions,
            markdown.code(about["command"]),
        ]
        return "\n\n".join(parts)

    def _picture(self, run_id: str, name: str) -> str:
        """Address of a figure in MLflow's UI."""
        return pages.run_page(self._runs.experiment_id, run_id, f"{FIGURES}/{name}.png")


def _metrics(state: dict[str, Any]) -> dict[str, float]:
    """A sweep in numbers."""
    outcomes = state["outcomes"]
    names = ("succeeded", "not succeeded", "error")
    counts = {f"trials/{name.replace(' ', '_')}": float(outcomes.get(name, 0)) for name in names}
    mean = state["mean_experiments"]
    return counts if mean is None else {**counts, "experiments/mean": mean}
