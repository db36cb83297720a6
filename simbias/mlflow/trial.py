"""A trial's run in MLflow, made from the trial's folder, live or later, repeatedly; the folder from a run."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from simbias.core.errors import ConfigError
from simbias.core.messages import redact
from simbias.core.records import Iteration
from simbias.mlflow import notes
from simbias.mlflow.pages import NOTE, PARENT, RUN_NAME, run_page
from simbias.mlflow.runs import OUTDATED, Point, RunExport, Runs, parent_of, superseded
from simbias.mlflow.store import client_of, database, reaching
from simbias.trial.continuation import continued
from simbias.trial.disk import LOCK, is_locked
from simbias.trial.folder import PICTURES, TrialFolder
from simbias.trial.summary import Outcome, TrialSummary

if TYPE_CHECKING:
    from mlflow.entities import Run

Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the C version is ten times faster
FOLDER = "trial"  # name of the trial's folder among a run's artifacts
ITERATIONS = "experiments/iterations"  # the metric with the number of exported iterations
SUPERSEDED = "**Superseded** by [a new run]({}): an experiment was withdrawn, or the trial was made again."
STATUS = {Outcome.ERROR: "FAILED", Outcome.INTERRUPTED: "KILLED", Outcome.WAITING: "SCHEDULED"}
KEY_LENGTH, VALUE_LENGTH = 250, 6000  # characters that MLflow accepts


class Nested(NamedTuple):
    """A trial's place in a sweep."""

    parent: str  # run
    name: str
    tags: Mapping[str, str]
    known: Sequence[Run]  # of earlier exports


class TrialExport(RunExport):
    """A trial's run, created once the trial's folder has content."""

    def __init__(self, runs: Runs, path: Path, nested: Nested | None = None) -> None:
        super().__init__(runs, path)
        self._folder, self._nested = TrialFolder(path), nested

    def iterated(self, iteration: Iteration) -> None:
        """Bring the run up to date."""
        self.update()

    def write(self, final: bool = False) -> None:
        """Write what the run lacks: files first, so that numbers appear last."""
        if began_at(self._folder):
            with self.runs.writing(self.path):
                self._write()

    def _write(self) -> None:
        """Write what the run lacks, while no other process does."""
        folder = self._folder
        courses = began_at(folder)
        description, iterations, summary = folder.description(), folder.iterations(), folder.summary()
        running, run_id, self.run_id = is_locked(self.path / LOCK), self.run_id, ""
        run = self.runs.client.get_run(run_id) if run_id else self._run(description, courses)
        tags = _tags(summary) if summary else {}
        for tag in {"error", "waiting", "outcome"} & run.data.tags.keys() - tags.keys():
            self.runs.client.delete_tag(run.info.run_id, tag)
        tags[NOTE] = notes.note(
            description, iterations, summary, running, folder.withdrawals(), continued(folder)
        )
        files: dict[str, Path | bytes] = {"config.yaml": as_yaml(description["config"])}
        files |= {artifact(file.relative_to(self.path)): file for file in folder.files()}
        given = {key: each for key, each in parameters(description).items() if key not in run.data.params}
        self.bring(run, files, tags, given, [*_new_metrics(iterations, summary, run)])
        status, end = "RUNNING" if running else "KILLED", None
        if summary is not None:
            status, end = STATUS.get(summary.outcome, "FINISHED"), int(1000 * summary.ended)
        self.runs.end(run, status, end)
        self.run_id = run.info.run_id  # otherwise it is looked up again

    def _run(self, description: Mapping[str, Any], courses: Sequence[int]) -> Run:
        """The run, created if necessary; the same trial, restarted in a new folder, gets another run.

        A trial with a withdrawn experiment also gets a new run, as MLflow cannot delete numbers; the previous
        run says so.
        """
        runs, nested, identity = self.runs, self._nested, description["hash"]
        if nested and (run := _begun(nested.known, courses[-1])):
            return runs.client.get_run(run.info.run_id)
        tags = {**origin_tags(description), "hash": identity}
        if nested:
            tags |= {PARENT: nested.parent, **nested.tags}
        every = runs.find(identity)
        found = [run for run in every if parent_of(run) == (nested.parent if nested else "")]
        if run := _begun(found, courses[-1]):
            if not nested and runs.free(run):
                runs.client.set_tag(run.info.run_id, RUN_NAME, notes.run_name(description))
            return run
        begun = [run for run in every if run.info.start_time == courses[-1]]
        if nested and (run := next(filter(runs.orphaned, begun), None)):
            for key, value in {PARENT: nested.parent, RUN_NAME: nested.name, **nested.tags}.items():
                runs.client.set_tag(run.info.run_id, key, value)
            runs.free(run)
            return run
        new = runs.create(nested.name if nested else notes.run_name(description), tags, courses[-1])
        for run in found:
            if (nested or run.info.start_time in courses) and not superseded(run):
                page = run_page(runs.experiment_id, new.info.run_id)
                note = f"{SUPERSEDED.format(page)}\n\n{run.data.tags.get(NOTE, '')}"
                runs.client.set_tag(run.info.run_id, NOTE, note)
                runs.client.set_tag(run.info.run_id, *OUTDATED)
        return new


def _begun(runs: Sequence[Run], time: int) -> Run | None:
    """The run with this start time in ms since the epoch."""
    return next((run for run in runs if run.info.start_time == time), None)


def artifact(file: Path) -> str:
    """The name of a trial's file among its run's artifacts; pictures have a separate folder."""
    return file.as_posix() if file.parts[0] == PICTURES else f"{FOLDER}/{file.as_posix()}"


def began_at(folder: TrialFolder) -> list[int]:
    """Times of the trial's start, if any, and of each restart after a withdrawal, ms since the epoch."""
    begun = [each["started"] for each in folder.attempts() if "started" in each][:1]
    return [int(1000 * time) for time in (*begun, *(each.time for each in folder.withdrawals()))]


def _new_metrics(
    iterations: Sequence[Mapping[str, Any]], summary: TrialSummary | None, run: Run
) -> Iterator[Point]:
    """The numbers that the run lacks, of each iteration and of a finished trial.

    The iteration's index comes last, so that a partially exported iteration is exported again.
    """
    for each in iterations[int(run.data.metrics.get(ITERATIONS, 0)) :]:
        step, time = each["iteration"], each["ended"]
        numbers = sorted(each["metrics"].items(), key=lambda item: item[0] == ITERATIONS)
        yield from ((_name(key), value, step, time) for key, value in numbers)
    if summary is not None and summary.outcome.final:
        new = {key: each for key, each in summary.metrics().items() if run.data.metrics.get(key) != each}
        yield from ((key, value, 0, summary.ended) for key, value in new.items())


def parameters(description: Mapping[str, Any]) -> dict[str, str]:
    """The chosen options (`bias`) and the resolved config (`bias.d`); values other than text as JSON."""
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
    """A key with only characters that MLflow allows in names."""
    return re.sub(r"[^\w\-. /]", "_", key)[:KEY_LENGTH]


def _value(value: Any) -> str:
    """Text unchanged, anything else as JSON; config.yaml has the full value if it is truncated."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= VALUE_LENGTH else text[: VALUE_LENGTH - 3] + "..."


def as_yaml(config: Mapping[str, Any]) -> bytes:
    """A config as a file's content."""
    return yaml.dump(config, Dumper=Dumper, sort_keys=False, allow_unicode=True, encoding="utf-8")


def origin_tags(description: Mapping[str, Any]) -> dict[str, str]:
    """The provenance of a run, as tags for MLflow's UI."""
    tags = {"mlflow.source.name": "simbias", "mlflow.source.type": "LOCAL"}
    if "user" in description:
        tags["mlflow.user"] = description["user"]
    if "commit" in description:
        tags["mlflow.source.git.commit"] = description["commit"]
        tags["git.changed"] = str(description["changed"]).lower()
    return {**tags, "versions": ", ".join(f"{name} {v}" for name, v in description["versions"].items())}


def _tags(summary: TrialSummary) -> dict[str, str]:
    """A trial's outcome and platforms, as tags."""
    tags = {
        "outcome": str(summary.outcome),
        "waiting" if summary.outcome is Outcome.WAITING else "error": summary.stopped_by,
        "test_episodes": summary.test_episodes,
        "platform": " then ".join(summary.platforms)[:VALUE_LENGTH],
        "processor": summary.processor,
    }
    return {name: text for name, text in tags.items() if text}


@contextmanager
def trial_folder(run_id: str, uri: str) -> Iterator[Path]:
    """The trial's folder, downloaded from its run, and deleted at the end of the context.

    ConfigError if the store cannot be used (a missing one is not created), or has no such trial.
    """
    file = database(uri)
    if file is not None and not file.exists():
        raise ConfigError(run_id, f"no such folder, and no store {redact(uri, uri)} to look for a run in")
    with tempfile.TemporaryDirectory() as folder:
        with reaching(uri):
            _download(run_id, uri, folder)
        yield Path(folder, FOLDER)


def _download(run_id: str, uri: str, folder: str) -> None:
    """Copy the trial's folder from its run."""
    from mlflow.exceptions import MlflowException

    client = client_of(uri)
    try:
        tags = client.get_run(run_id).data.tags
    except MlflowException as error:
        if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            raise
        raise ConfigError(run_id, f"no such run in {redact(uri, uri)}, and no such folder") from error
    if "sweep" in tags:
        raise ConfigError(run_id, "is a sweep; name the run of one of its trials")
    if "hash" not in tags:
        raise ConfigError(run_id, "is not a run of simbias")
    if not any(client.list_artifacts(run_id, FOLDER)):
        raise ConfigError(run_id, "its files are not in the store")
    client.download_artifacts(run_id, FOLDER, folder)
