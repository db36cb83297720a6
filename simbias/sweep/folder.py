"""The folder of a sweep: its trials and its results. Each trial has its own folder.

sweep.json                   name, hash, first start, command, config, axes; the trials' hashes and labels
state.json                   progress, its table and the table's meaning
trials.csv, table.csv, .md   a row for each trial, a row for each cell
experiments/<hash>.json      outcomes of additional experiments for figures
figures/                     the figures
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simbias.core.errors import ConfigError
from simbias.sweep.batches import Outcomes
from simbias.sweep.results import digest, numbers
from simbias.trial.disk import read_json, require_file, write_json, write_whole
from simbias.trial.folder import TrialFolder

SWEEP, STATE = "sweep.json", "state.json"
CHANGED = "Trials have changed since; run the sweep's command again to count them."
REMEDY = "Delete it: the command of the whole sweep recreates it from the trials"
FIGURES, EXPERIMENTS = "figures", "experiments"


@dataclass(frozen=True)
class SweepFolder:
    """A sweep's folder."""

    path: Path

    def begin(self, description: Mapping[str, Any]) -> None:
        """Write sweep.json; `started` (s since the epoch) stays that of the first start."""
        self.path.mkdir(parents=True, exist_ok=True)
        begun = (self.path / SWEEP).exists()
        started = self.description().get("started") if begun else time.time()  # None in earlier folders
        write_json(self.path / SWEEP, {**description, "started": started})

    def description(self) -> dict[str, Any]:
        """The content of sweep.json."""
        return self._read(SWEEP)

    def trials_recorded(self) -> set[str]:
        """The hashes of the trials in sweep.json; empty before it exists."""
        return {*self.description().get("trials", ())} if (self.path / SWEEP).exists() else set()

    def state(self) -> dict[str, Any]:
        """The content of state.json; empty before it exists."""
        return self._read(STATE) if (self.path / STATE).exists() else {}

    def _read(self, name: str) -> dict[str, Any]:
        """The content of one of its files; a ConfigError names the remedy."""
        try:
            return read_json(self.path / name)
        except ConfigError as error:
            raise ConfigError(error.key, f"{error.problem}. {REMEDY}") from error

    def write_state(self, state: Mapping[str, Any], files: Mapping[str, str] = {}) -> None:
        """Write the sweep's progress, and files by name."""
        for name, text in files.items():
            write_whole(self.path / name, text.encode())
        write_json(self.path / STATE, state)

    def changed(self) -> bool:
        """Whether trials have changed since state.json: another sweep ended them, or one was withdrawn."""
        trials = [TrialFolder(self.trials / name) for name in self.description()["trials"]]
        ended = ((each.path.name, each.summary()) for each in trials if each.ended)
        now = digest({name: numbers(summary) for name, summary in ended if summary})
        return self.state().get("digest", now) != now

    @property
    def trials(self) -> Path:
        """The folder of all trials."""
        return self.path.parent.parent

    def tables(self) -> list[Path]:
        """The files of tables."""
        return [file for file in sorted(self.path.glob("t*.*")) if file.suffix in (".csv", ".md")]

    def figures(self) -> list[Path]:
        """The files of the sweep's current figures; files of former ones may remain."""
        drawn = self.state().get("captions", ())
        return sorted(
            file for file in (self.path / FIGURES).glob("*") if file.stem in drawn and file.is_file()
        )

    def publish(self, files: Iterable[Path]) -> None:
        """Keep a figure's files; they replace those of the same names."""
        (self.path / FIGURES).mkdir(exist_ok=True)
        for file in files:
            write_whole(self.path / FIGURES / file.name, file.read_bytes())

    def keep_outcomes(self, batch: str, outcomes: Outcomes) -> None:
        """Keep the outcomes of a batch of experiments, by its hash."""
        (self.path / EXPERIMENTS).mkdir(exist_ok=True)
        write_whole(self.path / EXPERIMENTS / f"{batch}.json", outcomes.as_json().encode())

    def outcomes(self, batches: Sequence[str]) -> dict[str, Outcomes]:
        """The stored outcomes, by the hashes of their batches."""
        kept = {}
        for batch in batches:
            file = self.path / EXPERIMENTS / f"{batch}.json"
            with suppress(OSError, ValueError):
                kept[batch] = Outcomes.from_json(require_file(file).read_text(encoding="utf-8"))
        return kept


def sweep_folders(trials: Path) -> list[SweepFolder]:
    """The folders of sweeps beside the trials' folders."""
    return [SweepFolder(file.parent) for file in sorted(trials.glob(f"sweeps/*/{SWEEP}"))]
