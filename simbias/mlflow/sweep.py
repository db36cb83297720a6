"""A sweep in MLflow, made from its folder and its trials': a parent run, and a nested run for each."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from simbias.core import markdown
from simbias.mlflow import pages
from simbias.mlflow.runs import Runs
from simbias.mlflow.trial import NOTE, TrialExport, origin_tags, write_yaml
from simbias.sweep.folder import FIGURES, SweepFolder
from simbias.sweep.tracking import SweepExport
from simbias.trial.folder import TrialFolder

if TYPE_CHECKING:
    from mlflow.entities import Run

STATUS = {"**Running**": "RUNNING", "**Done**": "FINISHED", "**Interrupted**": "KILLED"}


class MlflowSweep(SweepExport):
    """A parent run.

    Parameters
    ----------
    runs
        Where it is, or will be.
    folder
        The sweep's.
    live
        Whether the sweep runs in this process: then its trials are exported as they end.
    """

    def __init__(self, runs: Runs, folder: SweepFolder, live: bool = False) -> None:
        self._runs, self._folder, self._live = runs, folder, live
        self._description = folder.description()
        self._uploaded: dict[str, int | None] = {}  # sizes of files
        self._parent = ""  # its run

    @property
    def where(self) -> str:  # type: ignore[override]
        """How a person looks at the run, or at the folder where the store is away."""
        return self._runs.address(self._parent) if self._parent else str(self._folder.path)

    def _run(self) -> Run:
        """The parent run, a new one if need be; its trials are listed by the sweep's axes."""
        about, runs = self._description, self._runs
        tags = {**origin_tags(about), "sweep": about["name"]}
        run = runs.run(about["hash"], tags=tags, run_name=f"sweep {about['name']}")
        if not self._parent:
            self._parent = run.info.run_id
            runs.find_nested(self._parent)
            runs.client.set_experiment_tag(runs.experiment_id, *pages.trials_view(about, self._parent))
        return run

    def trial_ended(self, folder: Path) -> None:
        """Export a trial into a nested run."""
        if not self._parent:  # the store is away: `update` will export it
            return
        trial = self._description["trials"][folder.name]
        labels = {pages.AXIS + name: label for name, label in trial["labels"].items()}
        tags, name = {"repetition": str(trial["repetition"]), **labels}, trial["name"]
        TrialExport(self._runs, folder, parent=self._parent, tags=tags, name=name).update()

    def update(self, final: bool = False) -> None:
        """Bring the parent run up to date, and at the end all trials that the store lacks."""
        self._runs.reach(lambda: self._update(final), final)

    def _update(self, final: bool) -> None:
        """Write what the run lacks."""
        state, run = self._folder.state(), self._run()
        client, run_id = self._runs.client, run.info.run_id
        if final:
            for identity in self._description["trials"]:
                folder = TrialFolder(self._folder.trials / identity)
                exported = self._live and self._runs.knows(identity, run_id)
                if folder.path.is_dir() and not exported:
                    self.trial_ended(folder.path)
        self._upload(run_id, final)
        verdict = state.get("verdict", "**Running**")
        client.set_tag(run_id, NOTE, self._note(state, run_id))
        if final:
            for name, value in _metrics(state).items():
                if run.data.metrics.get(name) != value:
                    client.log_metric(run_id, name, value, step=state["done"])
        status = STATUS.get(verdict, "FAILED") if self._live or verdict != "**Running**" else "KILLED"
        if status == "RUNNING":
            if run.info.status != status:
                client.update_run(run_id, status=status)
        elif run.info.status != status:
            client.set_terminated(run_id, status)

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
        if final and "table.json" not in self._uploaded:  # which MLflow shows as a table
            table = pd.read_csv(own.path / "table.csv", dtype={a["name"]: str for a in self._axes})
            client.log_table(run_id, table.astype(object), "table.json")
            self._uploaded["table.json"] = 0

    @property
    def _axes(self) -> list[dict[str, Any]]:
        """The sweep's axes."""
        return list(self._description["axes"])

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
