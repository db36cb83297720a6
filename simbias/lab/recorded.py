"""Recorded experiments in place of the robot: what was measured before is handed back, no policy runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np

from simbias.core import Hardware, HardwareError, Policy, Task
from simbias.core.files import ConfigFile
from simbias.core.records import Array, Rollout
from simbias.lab.checked_hardware import place_of
from simbias.lab.table import read_table

ENDS = "recording_ends"


@final
class Recorded(Hardware):
    """Experiment i of a trial is recording i, again from the first one after the last.

    A recording is a CSV file with a line of names, also compressed (.csv.gz). Between its lines, states and
    inputs change linearly; they are read off in each frame of the task, up to its horizon. One that is
    shorter counts as failed in its last frame.

    Parameters
    ----------
    folder
        Where the recordings are.
    files
        Their names, in order; by default every file of the folder, by name.
    columns
        The name of the column of `time` (s), and of each state and input; by default its own.
    """

    sets_start = False

    def __init__(
        self,
        task: Task,
        folder: ConfigFile,
        files: list[str] | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> None:
        names = [quantity.name for quantity in (*task.states, *task.inputs)]
        unknown = sorted(set(columns or {}) - {"time", *names})
        if unknown:
            raise ValueError(f"columns names what the task has not: {', '.join(unknown)}")
        self._task = task
        self._folder = Path(folder)
        self._files = files
        self._columns = [(columns or {}).get(name, name) for name in ("time", *names)]

    def run(self, policy: Policy, theta: Array, start: Array, rng: np.random.Generator) -> Rollout:
        """The next recording, numbered by the generator, which was spawned from the trial's."""
        files = self.files
        return self.rollout(files[([0, *place_of(rng)][-1]) % len(files)])

    @property
    def files(self) -> list[str]:
        """The recordings, in order."""
        files = self._files or sorted(path.name for path in self._folder.glob("*.csv*"))
        if not files:
            raise HardwareError(f"no recording (.csv, .csv.gz) is in {self._folder}")
        return files

    @property
    def source_files(self) -> list[Path]:
        """The recordings that are there, as files."""
        named = self._files or [path.name for path in self._folder.glob("*.csv*")]
        return [self._folder / name for name in sorted(named) if (self._folder / name).is_file()]

    def rollout(self, file: str) -> Rollout:
        """A recording in the task's frames, up to its horizon."""
        whole, horizon = self.read(self._folder / file), self._task.horizon
        if whole.frames < horizon:
            return replace(whole, failed_at=whole.frames, failure=ENDS)
        states = whole.states[: horizon + 1]
        return replace(whole, states=states, inputs=whole.inputs[:horizon], measured=states)

    def read(self, path: Path) -> Rollout:
        """A whole recording in the task's frames.

        Raises
        ------
        HardwareError
            If the file cannot be read, or its times do not increase.
        """
        columns = self._read(path)
        time, n = columns[0], len(self._task.states)
        if len(time) < 2 or not (np.diff(time) > 0).all():
            raise HardwareError(f"{path}: its times do not increase")
        frames = int((time[-1] - time[0]) / self._task.time_step + 1e-9)
        at = time[0] + self._task.time_step * np.arange(frames + 1)
        states, inputs = (
            np.array([np.interp(at, time, column) for column in some]).T
            for some in (columns[1 : n + 1], columns[n + 1 :])
        )
        return Rollout(states, inputs[:-1], measured=states, sensed=True)

    def _read(self, path: Path) -> Array:
        """The columns (1 + n + m, r) of time, states and inputs."""
        table = read_table(path)
        lacking = [name for name in self._columns if name not in table.names]
        if lacking:
            raise HardwareError(f"{path}: row 1: expected a column {', '.join(lacking)}, got none")
        return table.numbers([table.names.index(name) for name in self._columns]).T
