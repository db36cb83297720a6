"""A trial's run in MLflow, made from the trial's folder: as often as one likes, live or later."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from simbias.core.records import Iteration
from simbias.mlflow import notes
from simbias.mlflow.runs import Runs
from simbias.mlflow.writes import Point, Writes
from simbias.sweep.tracking import Export
from simbias.trial.folder import PICTURES, TrialFolder
from simbias.trial.summary import Outcome, TrialSummary

if TYPE_CHECKING:
    from mlflow.entities import Run

Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is ten times as fast
NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
FOLDER = "trial"  # of a run's artifacts: the trial's folder
ITERATIONS = "experiments/iterations"  # the metric that tells how many iterations are exported
STATUS = {Outcome.ERROR: "FAILED", Outcome.INTERRUPTED: "KILLED", Outcome.WAITING: "SCHEDULED"}
KEY_LENGTH, VALUE_LENGTH = 250, 6000  # characters that MLflow takes


class TrialExport(Export):
    """A trial's run.

    Parameters
    ----------
    runs
        Where it is, or will be.
    folder
        The trial's.
    live
        Whether the trial runs in this process; else one that has not stopped was killed.
    parent, tags, name
        Of a nested run.
    """

    def __init__(
        self,
        runs: Runs,
        folder: Path,
        live: bool = False,
        parent: str = "",
        tags: Mapping[str, str] = {},
        name: str = "",
    ) -> None:
        self._runs, self._folder, self._live = runs, TrialFolder(folder), live
        self._parent, self._tags, self._name = parent, tags, name
        self._uploaded: dict[str, int | None] = {}  # sizes of files
        self.run_id = ""

    def iterated(self, iteration: Iteration) -> None:
        """Bring the run up to date."""
        self.update()

    def update(self, final: bool = False) -> None:
        """Bring the run up to date with the folder; `final` tries a store again that was away."""
        if (self._folder.path / "trial.json").exists():
            self._runs.reach(self._update, final)

    @property
    def where(self) -> str:  # type: ignore[override]
        """How a person looks at the run, or at the folder where the store is away."""
        return self._runs.address(self.run_id) if self.run_id else str(self._folder.path)

    def _run(self) -> Run:
        """The run, a new one if need be."""
        description, attempts = self._folder.description(), self._folder.attempts()
        began = [1000 * each["started"] for each in attempts if "started" in each]
        return self._runs.run(
            description["hash"],
            self._parent,
            tags={**origin_tags(description), **self._tags},
            run_name=self._name or notes.run_name(description),
            start_time=int(began[0]) if began else None,
        )

    def _update(self) -> None:
        """Write what the run lacks: files first, so that who finds numbers finds all."""
        run, description, folder = self._run(), self._folder.description(), self._folder
        summary, iterations = folder.summary(), folder.iterations()
        writes, client, run_id = Writes(), self._runs.client, run.info.run_id
        writes.files += self._new_files(run_id)
        if not run.data.params:
            writes.files.append(("config.yaml", partial(write_yaml, description["config"])))
            writes.parameters |= parameters(description)
        logged, end = int(run.data.metrics.get(ITERATIONS, 0)), 0.0
        for each in iterations[logged:]:
            end = each["ended"]
            numbers = {_name(key): value for key, value in each["metrics"].items()}
            writes.metrics.append([(key, value, each["iteration"], end) for key, value in numbers.items()])
        state = "RUNNING" if summary is None and self._live else "KILLED"
        if summary is not None:
            end = summary.started + summary.seconds
            state = STATUS.get(summary.outcome, "FINISHED")
            writes.metrics.append(list(_changed(summary, run, end)))
            writes.tags |= _tags(summary)
        writes.tags[NOTE] = notes.note(description, iterations, summary, running=state == "RUNNING")
        for tag in {"error", "outcome"} & run.data.tags.keys() - writes.tags.keys():
            client.delete_tag(run_id, tag)
        writes.flush(client, run_id)
        if state == "RUNNING":
            if run.info.status != state:
                client.update_run(run_id, status=state)
        elif (run.info.status, run.data.tags.get("outcome")) != (state, writes.tags.get("outcome")):
            client.set_terminated(run_id, state, end_time=int(1000 * end) if end else None)
        self.run_id = run_id

    def _new_files(self, run_id: str) -> Iterator[tuple[str, Any]]:
        """Names among the artifacts, and what copies them there, of files that the run lacks."""
        if not self._uploaded:
            for place in (FOLDER, PICTURES):
                for file in self._runs.client.list_artifacts(run_id, place):
                    self._uploaded[file.path] = file.file_size
        for path in self._folder.files():
            inside = path.relative_to(self._folder.path).as_posix()
            name = inside if inside.startswith(f"{PICTURES}/") else f"{FOLDER}/{inside}"
            if self._uploaded.get(name) != (size := path.stat().st_size):
                self._uploaded[name] = size
                yield name, partial(shutil.copyfile, path)


def parameters(description: Mapping[str, Any]) -> dict[str, str]:
    """The chosen options (`bias`) and the resolved config (`bias.d`); what is not text as JSON."""
    flat = {**description["choices"], **dict(_flat(description["config"]))}
    return {_name(key): _value(value) for key, value in flat.items()}


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values."""
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _name(key: str) -> str:
    """A key of characters that MLflow allows in names."""
    return re.sub(r"[^\w\-. /]", "_", key)[:KEY_LENGTH]


def _value(value: Any) -> str:
    """Text as it is, anything else as JSON; config.yaml has what is cut off."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 3] + "..."


def write_yaml(config: Mapping[str, Any], path: Path) -> None:
    """Write a config."""
    path.write_text(yaml.dump(config, Dumper=Dumper, sort_keys=False, allow_unicode=True), encoding="utf-8")


def origin_tags(description: Mapping[str, Any]) -> dict[str, str]:
    """Where a run comes from, as MLflow's UI shows it."""
    tags = {"mlflow.source.name": "simbias", "mlflow.source.type": "LOCAL"}
    if "user" in description:
        tags["mlflow.user"] = description["user"]
    if "commit" in description:
        tags["mlflow.source.git.commit"] = description["commit"]
        tags["git.changed"] = str(description["changed"]).lower()
    return {**tags, "versions": ", ".join(f"{name} {v}" for name, v in description["versions"].items())}


def _tags(summary: TrialSummary) -> dict[str, str]:
    """How a trial ended, and on what it ran."""
    tags = {
        "outcome": str(summary.outcome),
        "error": summary.reason,
        "test_episodes": summary.test_episodes,
        "platform": " then ".join(summary.platforms)[:VALUE_LENGTH],
        "processor": summary.processor,
    }
    return {name: text for name, text in tags.items() if text}


def _changed(summary: TrialSummary, run: Run, time: float) -> Iterator[Point]:
    """The trial's numbers that the run lacks."""
    for name, value in summary.metrics().items():
        if run.data.metrics.get(name) != value:
            yield name, value, 0, time
