"""The journal of a trial: its experiments and searches, on disk before they are used.

A folder holds one file for each, numbered in the order in which they ended: `0000_search.json`,
`0001_experiment.npz`, ... A trial that is started again recalls them in this order, and goes on from there.
What a hardware returned that breaks its contract is kept beside them and never recalled: what is numbers in
`refused_0000.npz`, the rest in `refused_0000.txt`. The last process' traceback is in `error.txt`, the kinds
of machines that the trial ran on in `machines.txt`.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from filelock import FileLock, Timeout

from simbias.core import Hardware, Optimizer, Policy, Task
from simbias.core import platform as machine
from simbias.core.errors import ConfigError
from simbias.core.messages import words
from simbias.core.records import Array, Optimum, Rollout
from simbias.lab.checked_hardware import Conditions, Conducted
from simbias.trial.files import load_rollout, raw_parts, save_arrays, save_rollout
from simbias.trial.replay import RecallingOptimizer
from simbias.trial.run import Recorder, TrialRecord
from simbias.trial.study import Study

SEARCH, EXPERIMENT = "search.json", "experiment.npz"
PART = ".part"  # suffix of what is being written
ERROR, REFUSED, MACHINES = "error.txt", "refused_", "machines.txt"
MIXED = "simbias: trial %s mixes kinds of machines, so its last bits are of neither: %s; now %s"
LOCK_SECONDS = 5.0  # that a worker in place of a killed one waits until the system has let go of its lock


class Journal(Recorder):
    """Keeps experiments and searches in a folder, as long as no other process keeps the same trial.

    Parameters
    ----------
    folder
        Of this trial alone; it is made if need be.
    pictures
        Names of the pictures to draw at the trial's end.

    Raises
    ------
    ConfigError
        If the folder cannot be written, or another process runs this trial.
    """

    def __init__(self, folder: Path, pictures: Sequence[str] = ()) -> None:
        self.folder = folder
        self.pictures = pictures
        self._next = 0
        taken = ConfigError(str(folder), "another process is running this trial")
        self._lock = acquire(folder / "lock", LOCK_SECONDS, taken)
        for file in folder.glob(f"*{PART}"):  # of a process that was killed while it wrote
            file.unlink()

    def recalling(self, study: Study) -> Study:
        """The study, its hardware and its optimizer kept here."""
        self._next = 0
        self._note_machine()
        hardware = KeptHardware(study.hardware, study.task, study.conditions, self)
        optimizer = KeptOptimizer(study.optimizer, self)
        return replace(study, hardware=hardware, optimizer=optimizer)

    def _note_machine(self) -> None:
        """Note the kind of machine that the trial runs on; say so if it was begun on another."""
        file, here = self.folder / MACHINES, machine.kind()
        self.machines = file.read_text().splitlines() if file.exists() else []
        if here in self.machines:
            return
        if self.machines and any(self.folder.glob("[0-9]*")):
            logging.getLogger(__name__).warning(MIXED, self.folder.name, self.machines[-1], here)
        with file.open("a") as lines:
            lines.write(f"{here}\n")

    def explained(self, traceback: str) -> str:
        """Keep a traceback until the trial is gone on with; its file, unless that cannot be written."""
        path = self.folder / ERROR
        try:
            write_whole(path, lambda file: file.write(traceback.encode()))
        except OSError:  # which must not hide what raised
            return ""
        return str(path)

    def ended(self, record: TrialRecord) -> None:
        """Let another process go on with the trial."""
        if not record.traceback:
            with suppress(OSError):
                (self.folder / ERROR).unlink(missing_ok=True)
        self.release()

    def release(self) -> None:
        """Let another process have the folder."""
        self._lock.release()

    def discard(self) -> None:
        """Remove the folder, once everything in it is kept elsewhere."""
        self.release()
        remove(self.folder)

    def recall(self, kind: str) -> Path | None:
        """The next entry, if there is one.

        Raises
        ------
        ConfigError
            If it is of another kind: then the trial is no longer the one that was begun.
        """
        entries = sorted(self.folder.glob(f"{self._next:04d}_*"))
        if not entries:
            return None
        path = entries[0]
        if path.name != self._name(kind):
            raise self.changed(path)
        self._next += 1
        return path

    def keep(self, kind: str, write: Callable[[IO[bytes]], object]) -> None:
        """Keep an entry: whole, and on disk when this returns."""
        write_whole(self.folder / self._name(kind), write)
        self._next += 1

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> Sequence[Path]:
        """Keep what is no rollout: its files, which no trial recalls."""
        stems = (f"{REFUSED}{number:04d}" for number in itertools.count())
        stem = next(stem for stem in stems if not any(self.folder.glob(f"{stem}.*")))
        arrays, texts = raw_parts(returned)
        arrays |= {"asked_parameters": theta, "asked_start": start}
        numbers, text = self.folder / f"{stem}.npz", self.folder / f"{stem}.txt"
        write_whole(numbers, lambda file: save_arrays(file, arrays))
        lines = [why, *(f"{name}: {words}" for name, words in texts.items())]
        write_whole(text, lambda file: file.write("\n".join([*lines, ""]).encode()))
        return numbers, text

    def changed(self, path: Path) -> ConfigError:
        """What to say of an entry that does not fit the trial."""
        return ConfigError(
            str(path),
            "does not fit the trial: its code has changed since. Move the folder away to begin it anew",
        )

    def _name(self, kind: str) -> str:
        """The file of the next entry."""
        return f"{self._next:04d}_{kind}"


class KeptHardware(Conducted):
    """A hardware each of whose experiments is on disk before anyone sees it, and made but once."""

    def __init__(self, hardware: Hardware, task: Task, conditions: Conditions, journal: Journal) -> None:
        super().__init__(hardware, task, conditions)
        self._journal = journal

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """One experiment, or the one that was made in its place before.

        What breaks the contract is no entry: it would be recalled for ever.
        """
        path = self._journal.recall(EXPERIMENT)
        if path is not None:
            rollout = load_rollout(path)
            if not np.array_equal(rollout.parameters, theta):
                raise self._journal.changed(path)
            return rollout
        rollout = replace(super().run(policy, theta, start, rng), parameters=theta)
        self._journal.keep(EXPERIMENT, lambda file: save_rollout(file, rollout))
        return rollout

    def refuse(self, returned: Any, theta: Array, start: Array, why: str) -> str:
        """Keep it in the journal."""
        try:
            paths = self._journal.refuse(returned, theta, start, why)
        except Exception as error:  # which must not hide what was wrong
            return f"; it could not be kept ({words(error)})"
        return f"; it is kept in {paths[0]} and {paths[1].suffix}"


class KeptOptimizer(RecallingOptimizer):
    """An optimizer whose optima are on disk before anyone sees them."""

    def __init__(self, optimizer: Optimizer, journal: Journal) -> None:
        super().__init__(optimizer)
        self._journal = journal

    def recall(self) -> Optimum | None:
        """The next one of the journal."""
        path = self._journal.recall(SEARCH)
        if path is None:
            return None
        fields = json.loads(path.read_text())
        return Optimum(**{**fields, "parameters": np.array(fields["parameters"])})

    def keep(self, optimum: Optimum) -> None:
        """Write it into the journal."""
        fields = {**asdict(optimum), "parameters": optimum.parameters.tolist()}
        self._journal.keep(SEARCH, lambda file: file.write(json.dumps(fields).encode()))


def refusals(folder: Path) -> list[Path]:
    """The files of what was refused in a journal."""
    return sorted(path for path in folder.glob(f"{REFUSED}*") if path.suffix != PART)


def acquire(path: Path, timeout: float, taken: ConfigError) -> FileLock:
    """The lock of this file, in a folder that is made if need be.

    Raises
    ------
    ConfigError
        If the folder cannot be written; `taken` if another process holds the lock for so many seconds.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path)
        lock.acquire(timeout=timeout)
    except Timeout as error:
        raise taken from error
    except OSError as error:
        raise ConfigError(str(path.parent), f"cannot be written ({error.strerror})") from error
    return lock


def remove(folder: Path) -> None:
    """Remove a journal, and the folders above it that it leaves empty."""
    shutil.rmtree(folder, ignore_errors=True)
    remove_empty(folder.parent)


def remove_empty(folder: Path) -> None:
    """Remove the folder of an experiment's journals and the one above it, if nothing is in them."""
    with suppress(OSError):  # others are under way
        folder.rmdir()
        folder.parent.rmdir()


def write_whole(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file that is there in whole or not at all, and survives a power failure once this returns."""
    part = path.with_name(f"{path.name}{PART}")
    with part.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    if os.name == "posix":  # elsewhere a folder cannot be opened
        folder = os.open(path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
