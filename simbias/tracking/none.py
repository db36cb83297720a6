"""Keeping nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simbias.config import ConfigError
from simbias.interfaces import TrackedSweep, TrackedTrial, Tracking
from simbias.records import Array, Iteration, Rollout

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.pictures.sweep.batches import Outcomes
    from simbias.study import Study
    from simbias.sweep.grid import Sweep, Trial
    from simbias.tracking.trials import RecordedTrial
    from simbias.worker import TrialRecord


class NoTracking(Tracking):
    """No store."""

    def open(self, study: Study) -> TrackedTrial:
        """Begin a trial of which nothing is kept."""
        return UntrackedTrial()

    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin a sweep of which nothing is kept but what its table needs, and that only until it ends.

        Raises
        ------
        ConfigError
            If a figure of the sweep needs more.
        """
        for name, figure in sweep.figures.items():
            if figure.reads_trials:
                raise ConfigError("tracking", f"none keeps nothing of which to draw sweep.figures.{name}")
        return UntrackedSweep(sweep)

    def finished(self, sweep: Sweep) -> DataFrame:
        """No trial."""
        from simbias.tracking.results import frame

        return frame([], sweep)


class UntrackedTrial(TrackedTrial):
    """A trial of which nothing is kept."""

    where = None

    def experimented(self, iteration: int, experiment: int, theta: Array, rollout: Rollout) -> None:
        """Let a hardware experiment go."""

    def log(self, iteration: Iteration) -> None:
        """Let an iteration go."""

    def illustrate(self, pictures: Mapping[str, bytes]) -> None:
        """Let pictures go."""

    def close(self, error: BaseException | None = None) -> None:
        """Nothing is open."""


class UntrackedSweep(TrackedSweep):
    """A sweep whose trials are forgotten, but for a row of each."""

    where = None
    keeps = False
    finished: frozenset[str] = frozenset()

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        self._rows: list[dict[str, Any]] = []

    def keep(self, trial: Trial, study: Study, record: TrialRecord) -> None:
        """Keep a row of a trial."""
        from simbias.tracking.results import row_of_record

        self._rows.append(row_of_record(trial, record, study, self._sweep))

    def results(self) -> DataFrame:
        """The trials so far, in the sweep's order."""
        from simbias.tracking.results import frame

        order = {trial.hash: index for index, trial in enumerate(self._sweep.trials)}
        return frame(sorted(self._rows, key=lambda row: order[row["hash"]]), self._sweep)

    def load(self, run_id: str) -> RecordedTrial:
        """No trial is there in full."""
        raise LookupError("the trials were not kept")

    def keep_outcomes(self, batch: str, outcomes: Outcomes) -> None:
        """Let outcomes go."""

    def outcomes(self, batches: Sequence[str]) -> dict[str, Outcomes]:
        """None is kept."""
        return {}

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Let a figure go."""

    def close(self, error: BaseException | None = None) -> None:
        """Nothing is open."""
