"""The files of a trial's steps: first replayed, then appended."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.trial.disk import PART, loaded, read_json, write_whole
from simbias.trial.files import load_rollout
from simbias.trial.folder import SEARCH, TRIAL, TrialFolder, number, step_name

CHANGED = "was emptied, moved or changed while the trial ran. Restore it; the same command resumes the trial"


class StepFiles:
    """The steps of a folder, to which one process may append."""

    def __init__(self, folder: TrialFolder) -> None:
        self.folder = folder
        self.writes = False  # true only in a locked folder of an unfinished trial
        self._all: list[Path] = []  # existing and new ones, including superseded ones

    @cached_property
    def left(self) -> Iterator[Path]:
        """The existing steps that are still to be replayed; listed once the folder is locked."""
        return iter(self.folder.steps())

    def begin(self) -> list[Path]:
        """Start writing; return the existing steps."""
        for file in self.folder.path.glob(f"*{PART}"):  # left by a process that was killed while writing
            file.unlink()
        self.writes, self._all = True, self.folder.all_steps()
        return self._all

    def append(self, kind: str, content: bytes) -> None:
        """Append a step, atomically; it is on disk when this returns."""
        self.write(self.next(kind), content)

    def next(self, kind: str) -> Path:
        """The file of the next step; errors as for `check`."""
        self.check()
        return self.path(kind)

    def path(self, kind: str) -> Path:
        """The path of a new step after the existing ones."""
        steps = self._all if self.writes else self.folder.all_steps()
        return self.folder.path / step_name(number(steps[-1]) + 1 if steps else 0, kind)

    def write(self, file: Path, content: bytes) -> None:
        """Write the file of a step, which may exist even if the disk reports an error."""
        try:
            write_whole(file, content)
        finally:
            if file.exists():
                self._all.append(file)

    def check(self) -> None:
        """Compare the folder with what this process has read and written.

        ConfigError if it has other steps or no trial.json: somebody has emptied, moved or changed it.
        """
        path = self.folder.path
        if self.writes and (self.folder.all_steps() != self._all or not (path / TRIAL).exists()):
            raise ConfigError(str(path), CHANGED)


def check_steps(folder: TrialFolder) -> None:
    """ConfigError if a step is missing, or a search or an experiment cannot be read; nothing is replayed."""
    steps = folder.all_steps()
    for index, step in enumerate(steps):
        if number(step) != index:
            raise missing(folder.path / f"{index:04d}_*")
    for step in steps:
        if step.suffix == ".npz":
            loaded(step, load_rollout)
        elif step.name.endswith(SEARCH):
            read_json(step)


def missing(path: Path) -> ConfigError:
    """The error for a file missing from a trial's folder."""
    return ConfigError(str(path), "is missing. Put it back, or move the folder away to begin again")


def changed(path: Path) -> ConfigError:
    """The error for a step that does not fit: the trial's code or an earlier step has changed or is gone."""
    there = {*map(number, TrialFolder(path.parent).all_steps())}
    gone = next((index for index in range(number(path)) if index not in there), None)
    code = "its code, a file that it reads or this folder has changed since. Move"
    why = code if gone is None else f"step {gone:04d} is missing. Put it back, or move"
    return ConfigError(str(path), f"does not fit the trial: {why} the folder away to begin again")
