"""Recorded experiments instead of the robot: recordings are returned, and no policy runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task
from simbias.core.errors import ConfigError
from simbias.core.files import ConfigFile
from simbias.core.messages import words
from simbias.core.records import Array, Rollout
from simbias.lab.checked_hardware import place_of
from simbias.lab.recording import Reader
from simbias.lab.signals import checked_columns

CSV = (".csv", ".csv.gz")
ENDS = "recording_ends"


@final
class Recorded(Hardware):
    """Experiment i of a trial is recording i; after the last one, they start over.

    An iteration that stops early skips the recordings of its remaining experiments.

    A recording is a CSV file with a line of names, also compressed (.csv.gz), a ROS bag or an MCAP file.
    Between samples, states change linearly and inputs are held; a frame of the task has the states at its
    beginning and the mean inputs (`simbias.lab.recording`). A recording shorter than the horizon counts as
    failed in its last frame.

    Parameters
    ----------
    folder
        The folder of the recordings.
    files
        Their names, in order; by default every CSV file of the folder, by name.
    columns
        The names of the columns of `time` (s) and of each state and input, by default their own names,
        followed by the unit if it differs from the task's (`q1 [deg]`); for a ROS bag or an MCAP file
        `/topic.field[0]`.
    """

    sets_start = False

    def __init__(
        self,
        task: Task,
        folder: ConfigFile,
        files: list[str] | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> None:
        names = ["time", *(quantity.name for quantity in (*task.states, *task.inputs))]
        self._task = task
        self._folder = Path(folder)
        self._files = files
        self.reader = Reader(task, checked_columns(columns, names))

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The next recording; its number follows from the generator, spawned from the trial's.

        Raises
        ------
        ConfigError
            If there is none, it cannot be read, or it has a gap.
        """
        place, files = place_of(rng)[:2], self.files  # a random experiment's place is one level deeper
        if not files:
            raise ConfigError("hardware.folder", f"no recording ({', '.join(CSV)}) is in {self._folder}")
        try:
            return self.rollout(files[[0, *place][-1] % len(files)])
        except HardwareError as error:  # bad input, not the robot's fault
            raise ConfigError("", words(error)) from error

    @property
    def files(self) -> list[str]:
        """The recordings, in order: the given file names, or those of the folder's CSV files."""
        return self._files or sorted(path.name for path in self._folder.glob("*") if path.name.endswith(CSV))

    @property
    def source_files(self) -> list[Path]:
        """The existing files of the recordings."""
        return [path for name in sorted(self.files) if (path := self._folder / name).is_file()]

    def rollout(self, file: str) -> Rollout:
        """A recording in the task's frames, up to its horizon.

        Raises
        ------
        HardwareError
            If the file cannot be read, or contains a gap, a reset or a jump.
        """
        pieces, horizon = self.reader.read(self._folder / file).pieces, self._task.horizon
        if len(pieces) > 1:
            raise HardwareError(f"{self._folder / file}: it has a gap, a reset of its time, or a jump")
        (whole,) = pieces
        if whole.frames < horizon:
            return replace(whole, failed_at=whole.frames, failure=ENDS)
        return whole.part(0, horizon)
