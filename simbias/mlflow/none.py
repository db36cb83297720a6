"""Keeping nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simbias.core.errors import ConfigError
from simbias.sweep.tracking import TrackedSweep, TrackedTrial, Tracking
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study

if TYPE_CHECKING:
    from pandas import DataFrame

    from simbias.sweep.batches import Outcomes
    from simbias.sweep.grid import Sweep, Trial
    from simbias.trial.run import RecordedTrial


class NoTracking(Tracking):
    """No store."""

    def open(self, study: Study) -> TrackedTrial:
        """Begin a trial of which nothing is kept."""
        return TrackedTrial()

    def open_sweep(self, sweep: Sweep, again: str) -> TrackedSweep:
        """Begin a sweep of which nothing is kept but what its table needs, and that only until it ends.

        Raises
        ------
        ConfigError
            If a figure of the sweep needs more.
        """
        for name, figure in sweep.figures.items():
            if figure.reads_trials:
                raise ConfigError(
                    "tracking", f"none keeps no trials, and sweep.figures.{name} is drawn from them"
                )
        return UntrackedSweep(sweep)

    def finished(self, sweep: Sweep) -> DataFrame:
        """No trial."""
        from simbias.mlflow.results import frame

        return frame([], sweep)


class UntrackedSweep(TrackedSweep):
    """A sweep whose trials are forgotten, but for a row of each."""

    where = None
    keeps = False
    finished: frozenset[str] = frozenset()

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        self._rows: list[dict[str, Any]] = []

    def journal(self, trial: Trial) -> None:
        """No folder."""

    def keep(self, trial: Trial, study: Study, record: TrialRecord) -> None:
        """Keep a row of a trial."""
        from simbias.mlflow import results
        from simbias.mlflow.fields import holds, trial_metrics

        if record.outcome in results.TOLD:
            numbers = trial_metrics(record)
            own = results.row(
                trial, self._sweep, record.outcome, numbers, record.reason, held_out=holds(record)
            )
            self._rows.append(own)

    def results(self) -> DataFrame:
        """The trials so far, in the sweep's order."""
        from simbias.mlflow.results import frame

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
