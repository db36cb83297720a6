"""The contract of stores: they keep trials and sweeps, and find them again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from simbias.trial.run import Recorder, TrialRecord
from simbias.trial.study import Study

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.sweep.batches import Outcomes
    from simbias.sweep.grid import Sweep, Trial
    from simbias.trial.run import RecordedTrial


class Tracking(ABC):
    """A store."""

    @abstractmethod
    def open(self, study: Study) -> TrackedTrial:
        """Begin the record of a trial, or go on with it.

        Raises
        ------
        ConfigError
            If the store cannot be used, or another process runs this trial.
        """

    @abstractmethod
    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin the record of a sweep, or go on with it; `again` is the command that does so.

        Raises
        ------
        ConfigError
            If the store cannot be used, or another process runs this sweep.
        """

    @abstractmethod
    def finished(self, sweep: Sweep) -> DataFrame:
        """What is kept of a sweep's finished trials: see `simbias.mlflow.results`; changes nothing."""


class TrackedTrial(Recorder):
    """The open record of one trial; every call returns after its data is safe. This one keeps nothing."""

    where: str | None = None  # one line that tells a person how to look at it
    changed: str = ""  # which code of the user's has changed since the trial began, in one line

    def finished(self) -> RecordedTrial | None:
        """The trial, if it has come to its end before."""
        return None


class TrackedSweep(ABC):
    """The open record of a sweep."""

    where: str | None  # one line that tells a person how to look at it
    changed: str = ""  # which code of the user's has changed since trials of it ran, in one line
    keeps: bool  # whether a later process finds the finished trials
    finished: frozenset[str]  # hashes of the trials that were finished before
    pictures: Sequence[str] = ()  # of each trial, to be drawn at its end

    @abstractmethod
    def journal(self, trial: Trial) -> Path | None:
        """The folder in which a worker keeps a trial while it runs, if anything is kept."""

    @abstractmethod
    def keep(self, trial: Trial, study: Study, record: TrialRecord) -> None:
        """Keep all of a trial; it counts as finished once everything is written and it came to its end."""

    @abstractmethod
    def results(self) -> DataFrame:
        """The trials that came to an end or raised, as `simbias.mlflow.results` describes them."""

    @abstractmethod
    def load(self, run_id: str) -> RecordedTrial:
        """A trial that was kept, in full."""

    @abstractmethod
    def keep_outcomes(self, batch: str, outcomes: Outcomes) -> None:
        """Keep the outcomes of a batch of experiments, by its hash."""

    @abstractmethod
    def outcomes(self, batches: Sequence[str]) -> dict[str, Outcomes]:
        """Those outcomes that are kept, by the hashes of their batches."""

    @abstractmethod
    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Keep a figure; its files replace those of the same names."""

    @abstractmethod
    def close(self, error: BaseException | None = None) -> None:
        """End the record with the table of what is there; the error says why it ended early."""
