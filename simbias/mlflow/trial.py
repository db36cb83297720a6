"""A trial's run in MLflow, made from the trial's folder: as often as one likes, live or later."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from simbias.core.records import Iteration
from simbias.mlflow import notes
from simbias.mlflow.pages import PARENT
from simbias.mlflow.runs import Runs
from simbias.mlflow.writes import Point, Writes
from simbias.sweep.tracking import Export
from simbias.trial.disk import LOCK, is_locked
from simbias.trial.folder import PICTURES, TRIAL, TrialFolder
from simbias.trial.summary import Outcome, TrialSummary

if TYPE_CHECKING:
    from mlflow.entities import Run

Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is ten times as fast
NOTE = "mlflow.note.content"  # MLflow's tag for a run's description
FOLDER = "trial"  # of a run's artifacts: the trial's folder
ITERATIONS = "experiments/iterations"  # the metric that tells how many iterations are exported
STATUS = {Outcome.ERROR: "FAILED", Outcome.INTERRUPTED: "KILLED", Outcome.WAITING: "SCHEDULED"}
KEY_LENGTH, VALUE_LENGTH = 250, 6000  # characters that MLflow takes


class Nested(NamedTuple):
    """A trial's place in a sweep."""

    parent: str  # run
    name: str
    tags: Mapping[str, str]
    run: Run | None  # of an earlier export


class TrialExport(Export):
    """A trial's run.

    Parameters
    ----------
    runs
        Where it is, or will be.
    folder
        The trial's.
    nested
        Its place in a sweep.
    """

    def __init__(self, runs: Runs, folder: Path, nested: Nested | None = None) -> None:
        self._runs, self._folder, self._nested = runs, TrialFolder(folder), nested
        self._uploaded: dict[str, int | None] | None = None  # sizes of files
        self.run_id = ""

    def iterated(self, iteration: Iteration) -> None:
        """Bring the run up to date."""
        self.update()

    def update(self, final: bool = False) -> None:
        """Bring the run up to date with the folder; `final` tries a store again that was away."""
        self._runs.reach(self.write, final)

    @property
    def where(self) -> str:  # type: ignore[override]
        """How a person looks at the run, or at the folder where the store is away."""
        path = self._folder.path
        return self._runs.address(path.name, self.run_id) if self.run_id else str(path)

    def write(self) -> None:
        """Write what the run lacks: files first, so that who finds numbers finds all.

        Raises
        ------
        ConfigError
            If a file of the folder cannot be read.
        """
        if not (began := began_at(self._folder)):
            return
        description, iterations = self._folder.description(), self._folder.iterations()
        summary, running = self._folder.summary(), is_locked(self._folder.path / LOCK)
        (run_id, uploaded), self.run_id, self._uploaded = (self.run_id, self._uploaded), "", None
        run = self._runs.client.get_run(run_id) if run_id else self._run(description, began)
        sizes, known = self._sizes(), uploaded if uploaded is not None else self._listed(run)
        new = [name for name in sizes if sizes[name] != known.get(name)]
        writes = Writes(
            files=[(name, self._copy(name)) for name in new], tags=_tags(summary) if summary else {}
        )
        if f"{FOLDER}/{TRIAL}" in new:
            writes.files.append(("config.yaml", partial(write_yaml, description["config"])))
        kept = run.data.params
        writes.parameters = {key: each for key, each in parameters(description).items() if key not in kept}
        writes.metrics += _new_metrics(iterations, summary, run)
        writes.tags[NOTE] = notes.note(description, iterations, summary, running)
        for tag in {"error", "outcome"} & run.data.tags.keys() - writes.tags.keys():
            self._runs.client.delete_tag(run.info.run_id, tag)
        writes.flush(self._runs.client, run.info.run_id)
        self._end(run, summary, running)
        self.run_id, self._uploaded = run.info.run_id, sizes  # else both are looked up again

    def _run(self, description: Mapping[str, Any], began: int) -> Run:
        """The run, a new one if need be: the same trial, begun again in a new folder, has another one."""
        nested, known = self._nested, [self._nested.run] if self._nested and self._nested.run else []
        found = known if nested else self._runs.find(description["hash"])
        for run in found:
            if run.info.start_time == began:
                return run
        tags = {**origin_tags(description), "hash": description["hash"]}
        if nested:
            tags |= {PARENT: nested.parent, **nested.tags}
        return self._runs.create(nested.name if nested else notes.run_name(description), tags, began)

    def _end(self, run: Run, summary: TrialSummary | None, running: bool) -> None:
        """Set the run's status."""
        status, outcome = "RUNNING" if running else "KILLED", None
        if summary is not None:
            status, outcome = STATUS.get(summary.outcome, "FINISHED"), str(summary.outcome)
        if (run.info.status, run.data.tags.get("outcome")) == (status, outcome):
            return
        if status == "RUNNING":
            self._runs.client.update_run(run.info.run_id, status=status)
        else:
            end = int(1000 * summary.ended) if summary else None
            self._runs.client.set_terminated(run.info.run_id, status, end_time=end)

    def _listed(self, run: Run) -> dict[str, int | None]:
        """Sizes of the files among the run's artifacts."""
        if not run.data.metrics and not run.data.params:  # a new one, which has none
            return {}
        listed, run_id = self._runs.client.list_artifacts, run.info.run_id
        return {file.path: file.file_size for file in (*listed(run_id, FOLDER), *listed(run_id, PICTURES))}

    def _sizes(self) -> dict[str, int | None]:
        """Sizes of the folder's files by their names among the artifacts, where pictures lie apart."""
        files = {file.relative_to(self._folder.path).as_posix(): file for file in self._folder.files()}
        return {
            name if name.startswith(f"{PICTURES}/") else f"{FOLDER}/{name}": file.stat().st_size
            for name, file in files.items()
        }

    def _copy(self, name: str) -> Callable[[Path], object]:
        """What copies a file of the folder by its name among the artifacts."""
        return partial(shutil.copyfile, self._folder.path / name.removeprefix(f"{FOLDER}/"))


def began_at(folder: TrialFolder) -> int:
    """When a trial began, in ms since the epoch; 0 if it has not."""
    return next((int(1000 * each["started"]) for each in folder.attempts() if "started" in each), 0)


def _new_metrics(
    iterations: Sequence[Mapping[str, Any]], summary: TrialSummary | None, run: Run
) -> Iterator[list[Point]]:
    """The numbers that the run lacks: a list for each iteration, and one for the trial that has ended."""
    for each in iterations[int(run.data.metrics.get(ITERATIONS, 0)) :]:
        step, time = each["iteration"], each["ended"]
        yield [(_name(key), value, step, time) for key, value in each["metrics"].items()]
    if summary is not None and summary.outcome.final:
        new = {key: each for key, each in summary.metrics().items() if run.data.metrics.get(key) != each}
        yield [(key, value, 0, summary.ended) for key, value in new.items()]


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
