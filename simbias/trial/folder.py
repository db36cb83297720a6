"""The folder of a trial: its config and every step that it made, only ever appended to.

    trial.json              composed config, chosen options, versions, the user's own code; written first
    attempts.jsonl          a line for each process that began to run the trial, and one for how that stopped
    0000_search.json        the steps in the order in which they ended:
    0001_experiment.npz     searches, hardware experiments,
    0002_iteration.json     iterations, with all that was measured of them in numbers
    test_episodes.csv       test of the last policy, if one was asked for
    outcome.json            how the trial ended; without it, the trial has not ended
    refused_0000.npz, .txt  what a hardware returned that is no rollout
    error_0000.txt          the traceback of an attempt
    pictures/               drawn of all this; may be deleted

A trial that is run again replays its steps and goes on from there; one that is read replays them and stops.
Whatever else shows a trial, a table, a picture or an MLflow run, is made from its folder.
"""

from __future__ import annotations

import itertools
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

from simbias.core import platform
from simbias.core.errors import ConfigError
from simbias.core.messages import with_type, words
from simbias.core.records import Array, Iteration, Optimum, Rollout
from simbias.trial.disk import LOCK, PART, append_line, locked, read_json, read_lines, write_json, write_whole
from simbias.trial.files import load_rollout, raw_parts, save_arrays, save_rollout
from simbias.trial.origin import description
from simbias.trial.replay import EndOfRecord, Record
from simbias.trial.study import Study
from simbias.trial.summary import TrialSummary, iteration_summary

TRIAL, ATTEMPTS, OUTCOME, EPISODES = "trial.json", "attempts.jsonl", "outcome.json", "test_episodes.csv"
SEARCH, EXPERIMENT, ITERATION = "search.json", "experiment.npz", "iteration.json"
ERROR, REFUSED, PICTURES = "error_", "refused_", "pictures"
COMPARED = ("iteration", "total_experiments", "succeeded")  # of an iteration with its replay
MIXED = "simbias: trial %s mixes platforms, so its last bits are of neither: %s; now %s"
LOCK_SECONDS = 5.0  # that a worker in place of a killed one waits until the system has let go of its lock


Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class TrialFolder:
    """A trial's folder, as it is read; it may be of a trial under way."""

    path: Path

    def description(self) -> dict[str, Any]:
        """The content of trial.json.

        Raises
        ------
        ConfigError
            If there is none, or it cannot be read.
        """
        return read_json(self.path / TRIAL)

    @property
    def ended(self) -> bool:
        """Whether the trial has ended; else it runs, or can be resumed.

        An outcome that somebody damaged is none: it follows from the steps.
        """
        try:
            return (self.path / OUTCOME).exists() and self.summary() is not None
        except ConfigError:
            return False

    def summary(self) -> TrialSummary | None:
        """How the trial ended, or how its last attempt stopped; None if it runs, or was killed.

        Raises
        ------
        ConfigError
            If it cannot be read.
        """
        file = self.path / OUTCOME
        try:
            if file.exists():
                return TrialSummary.from_json(read_json(file))
            stops = self.attempts()[-1:]
            return TrialSummary.from_json(stops[0]["stopped"]) if stops and "stopped" in stops[0] else None
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(str(file), f"cannot be read ({words(error)})") from error

    def attempts(self) -> list[dict[str, Any]]:
        """The lines of attempts.jsonl; one that a kill cut off is left out."""
        return read_lines(self.path / ATTEMPTS)

    def platforms(self) -> list[str]:
        """The platforms that the trial ran on, in their order."""
        return list(dict.fromkeys(each["platform"] for each in self.attempts() if "platform" in each))

    def seconds(self) -> float:
        """Wall time of all attempts but those that were killed, s."""
        stops = [each["stopped"] for each in self.attempts() if "stopped" in each]
        return float(stops[-1]["seconds"]) if stops else 0.0  # which has that of those before it

    def steps(self) -> list[Path]:
        """The files of the steps, in their order."""
        found = (file for file in self.path.glob("[0-9]*_*") if file.suffix != PART)
        return sorted(found, key=lambda file: int(file.name.partition("_")[0]))

    def iterations(self) -> list[dict[str, Any]]:
        """The iterations that have ended, as `simbias.trial.summary.iteration_summary` describes them."""
        return [read_json(file) for file in self.steps() if file.name.endswith(ITERATION)]

    def files(self) -> list[Path]:
        """All files but those that are being written."""
        found = (file for file in self.path.rglob("*") if file.is_file() and not file.name.startswith("."))
        return sorted(file for file in found if file.suffix != PART)


class FolderRecord(Record):
    """The steps of a trial in its folder: replayed as far as they go, then appended, or at an end if read.

    Raises
    ------
    ConfigError
        If the folder cannot be written, or another process runs this trial.
    """

    def __init__(self, path: Path, study: Study, *, writes: bool = True) -> None:
        self.folder = TrialFolder(path)
        self._study = study
        self._writes = writes
        self._next = 0
        self._iterations: list[Iteration] = []

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Hold the folder for this process, unless the trial is only read, or has ended."""
        taken = ConfigError(str(self.folder.path), "another process is running this trial")
        lock = locked(self.folder.path / LOCK, LOCK_SECONDS, taken)
        with lock if self._writes and not self.folder.ended else nullcontext():
            self._writes = self._writes and not self.folder.ended  # meanwhile, by another process
            if self._writes:
                self._begin()
            yield

    def _begin(self) -> None:
        """Write what is known before the first step, and that an attempt begins."""
        path = self.folder.path
        for file in path.glob(f"*{PART}"):  # of a process that was killed while it wrote
            file.unlink()
        if not (path / TRIAL).exists():
            write_json(path / TRIAL, description(self._study))
        here, before = platform.kind(), self.folder.platforms()
        if before and here not in before and self.folder.steps():
            logging.getLogger(__name__).warning(MIXED, path.name, before[-1], here)
        append_line(
            path / ATTEMPTS, {"started": time.time(), "platform": here, "processor": platform.processor()}
        )

    def search(self, make: Callable[[], Optimum]) -> Optimum:
        """The next search."""
        path = self._replayed(SEARCH)
        if path is not None:
            return _loaded(path, _load_search)
        optimum = make()
        fields = {**asdict(optimum), "parameters": optimum.parameters.tolist()}
        self._keep(SEARCH, lambda file: file.write(json.dumps(fields).encode()))
        return optimum

    def experiment(self, theta: Array, make: Callable[[], Rollout]) -> Rollout:
        """The next experiment; what breaks the contract is no step, as it would be replayed for ever."""
        path = self._replayed(EXPERIMENT)
        if path is not None:
            rollout = _loaded(path, load_rollout)
            if not np.array_equal(rollout.parameters, theta):
                raise changed(path)
            return rollout
        rollout = make()
        self._keep(EXPERIMENT, lambda file: save_rollout(file, rollout))
        return rollout

    def iteration(self, iteration: Iteration) -> Iteration:
        """The iteration that has ended; if it did before, with the seconds that it took then."""
        earlier = tuple(self._iterations)
        path = self._replayed(ITERATION)
        if path is None:
            summary = {**iteration_summary(self._study, iteration, earlier), "ended": time.time()}
            self._keep(ITERATION, lambda file: file.write(_dumped(summary)))
        else:
            *kept, seconds = _loaded(path, lambda path: itemgetter(*COMPARED, "seconds")(read_json(path)))
            if kept != [iteration.index, iteration.total_experiments, iteration.succeeded]:
                raise changed(path)
            iteration = replace(iteration, seconds=seconds)
        self._iterations.append(iteration)
        return iteration

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep what is no rollout beside the steps; what could not be kept hides no error."""
        try:
            paths = self._refused(returned, theta, start, why)
        except Exception as error:
            return f"; it could not be kept ({words(error)})"
        return f"; it is kept in {paths[0]} and {paths[1].suffix}"

    def _refused(self, returned: Any, theta: Array, start: Array, why: str) -> Sequence[Path]:
        """The files of what is no rollout: its numbers, and the rest as text."""
        path = self.folder.path
        stems = (f"{REFUSED}{number:04d}" for number in itertools.count())
        stem = next(stem for stem in stems if not any(path.glob(f"{stem}.*")))
        arrays, texts = raw_parts(returned)
        arrays |= {"asked_parameters": theta, "asked_start": start}
        numbers, text = path / f"{stem}.npz", path / f"{stem}.txt"
        write_whole(numbers, lambda file: save_arrays(file, arrays))
        lines = [why, *(f"{name}: {said}" for name, said in texts.items())]
        write_whole(text, lambda file: file.write("\n".join([*lines, ""]).encode()))
        return numbers, text

    def traceback(self, text: str) -> str:
        """Keep an attempt's traceback; its file, or "" where it cannot be written."""
        count = sum("started" in each for each in self.folder.attempts())
        file = self.folder.path / f"{ERROR}{max(0, count - 1):04d}.txt"
        try:
            write_whole(file, lambda stream: stream.write(text.encode()))
        except OSError:  # which must not hide what raised
            return ""
        return str(file)

    def stop(self, summary: TrialSummary, episodes: str | None = None) -> None:
        """Keep how the trial ended, or how this attempt stopped; `episodes` is the test's CSV."""
        if not self._writes:
            return
        if episodes is not None:
            write_whole(self.folder.path / EPISODES, lambda file: file.write(episodes.encode()))
        if summary.outcome.final:
            write_json(self.folder.path / OUTCOME, summary.as_json())
        else:
            append_line(self.folder.path / ATTEMPTS, {"stopped": summary.as_json()})

    def _replayed(self, kind: str) -> Path | None:
        """The next step, if there is one.

        Raises
        ------
        ConfigError
            If it is of another kind: then the trial's code is not what it was.
        EndOfRecord
            If there is none, and the trial is only read.
        """
        steps = [file for file in self.folder.path.glob(f"{self._next:04d}_*") if file.suffix != PART]
        if not steps:
            if not self._writes:
                raise EndOfRecord
            return None
        if steps[0].name != self._name(kind):
            raise changed(steps[0])
        self._next += 1
        return steps[0]

    def _keep(self, kind: str, write: Callable[[IO[bytes]], object]) -> None:
        """Append a step: whole, and on disk when this returns."""
        write_whole(self.folder.path / self._name(kind), write)
        self._next += 1

    def _name(self, kind: str) -> str:
        """The file of the next step."""
        return f"{self._next:04d}_{kind}"


def changed(path: Path) -> ConfigError:
    """The error of a step that does not fit the trial."""
    return ConfigError(
        str(path), "does not fit the trial: its code has changed since. Move the folder away to begin again"
    )


def _loaded(path: Path, load: Callable[[Path], Loaded]) -> Loaded:
    """The content of a step.

    Raises
    ------
    ConfigError
        If it cannot be read.
    """
    try:
        return load(path)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(str(path), f"cannot be read ({with_type(error)})") from error


def _load_search(path: Path) -> Optimum:
    """The optimum that a search found."""
    fields = read_json(path)
    return Optimum(**{**fields, "parameters": np.array(fields["parameters"])})


def _dumped(content: Mapping[str, Any]) -> bytes:
    """A mapping as JSON; NumPy's numbers are numbers."""
    return json.dumps(content, indent=1, default=lambda value: value.tolist()).encode()
