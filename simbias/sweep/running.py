"""Running a sweep: what is missing is run and kept, trial by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pandas import DataFrame

from simbias.config import ConfigError, Variations
from simbias.config.build import build
from simbias.engine.contract import Engine, WorkerLostError
from simbias.sweep.grid import Sweep, Trial, expanded
from simbias.sweep.interruption import Interruption, stopping_workers
from simbias.sweep.making import FigureObserver, make_figures
from simbias.sweep.services import engine, tracking
from simbias.sweep.tracking import TrackedSweep, Tracking
from simbias.sweep.worker import Plan, lost, run_plan
from simbias.testing.rehearsal import rehearse
from simbias.trial.run import TrialRecord
from simbias.trial.study import Study


class SweepObserver(FigureObserver):
    """Hears of what happens in a sweep, while it happens."""

    def begun(self, sweep: Sweep, finished: DataFrame, keeps: bool) -> None:
        """The trials begin, but for those that are finished; `keeps` tells whether any is kept."""

    def ended(self, trial: Trial, record: TrialRecord) -> None:
        """A trial has ended, and is kept."""

    def all_ended(self) -> None:
        """No trial runs any more, however that came about."""


def run(
    overrides: Sequence[str],
    config_dir: Path | str | None = None,
    observer: SweepObserver | None = None,
    allow: Sequence[str] = (),
) -> DataFrame:
    """Compose a sweep and run what is missing of it; see `run_sweep`.

    Raises
    ------
    ConfigError
        If anything is bad about the sweep; nothing has run then.
    """
    variations = Variations(overrides, config_dir, allow)
    composition = variations.composition({})
    if "sweep" not in composition.config:
        raise ConfigError("sweep", "missing: +sweep=NAME names one")
    trials_engine, store = engine(composition), tracking(composition)
    sweep, _, _ = prepare(store, variations)
    again = f"simbias.run_sweep({list(overrides)!r})"
    return run_sweep(sweep, trials_engine, store.open_sweep(sweep, again), observer)


def prepare(store: Tracking, variations: Variations) -> tuple[Sweep, Study, DataFrame]:
    """The sweep, the study of its first cell, and the finished trials that the store keeps.

    The components of every cell could be built. Where trials are missing, the simulation is compiled.

    Raises
    ------
    ConfigError
        If anything is bad about the sweep or one of its cells; nothing has run then.
    """
    sweep = expanded(variations)
    studies: dict[tuple[str, ...], Study] = {}
    for cell in sweep.cells:
        try:
            study = build(cell.composition)
        except ConfigError as error:
            where = f" (in the cell {' '.join(cell.labels)})" if cell.labels else ""
            raise ConfigError("", f"{error}{where}") from error
        studies.setdefault(tuple(sorted(cell.composition.choices.values())), study)
    finished = store.finished(sweep)
    if len(finished) < len(sweep.trials):
        for study in studies.values():  # compiled here once, workers find it in the cache
            rehearse(study)
    return sweep, next(iter(studies.values())), finished


def run_sweep(
    sweep: Sweep, trials_engine: Engine, tracked: TrackedSweep, observer: SweepObserver | None = None
) -> DataFrame:
    """Run the trials that are not finished, and keep each as it ends; then make the figures.

    Returns the trials, as `simbias.mlflow.results` describes them.

    Raises
    ------
    KeyboardInterrupt
        On SIGINT or SIGTERM, between two trials; what has ended is kept.
    FigureError
        If a figure cannot be drawn from what there is.
    """
    observer = observer or SweepObserver()
    missing = [trial for trial in sweep.trials if trial.hash not in tracked.finished]
    try:
        with Interruption() as interruption:
            trials = tracked.results()
            observer.begun(sweep, trials[trials["hash"].isin(tracked.finished)], tracked.keeps)
            try:
                for trial, record in _records(trials_engine, tracked, missing):
                    with interruption.defer():
                        tracked.keep(trial, build(trial.composition), record)
                        observer.ended(trial, record)
            finally:
                observer.all_ended()
            make_figures(sweep, trials_engine, tracked, observer, interruption)
    except BaseException as error:
        tracked.close(error)
        raise
    tracked.close()
    return tracked.results()


def _records(
    trials_engine: Engine, tracked: TrackedSweep, trials: Sequence[Trial]
) -> Iterator[tuple[Trial, TrialRecord]]:
    """Trials with their records, as they end."""
    plans = [_plan(trial, tracked) for trial in trials]
    with stopping_workers(trials_engine.run(run_plan, plans)) as results:
        for index, result in results:
            yield trials[index], lost(str(result)) if isinstance(result, WorkerLostError) else result


def _plan(trial: Trial, tracked: TrackedSweep) -> Plan:
    """What a worker is told of a trial."""
    journal, composition = tracked.journal(trial), trial.composition
    folder = None if journal is None else str(journal.absolute())
    pictures = () if trial.repetition else tuple(tracked.pictures)  # a cell's first trial stands for all
    return Plan(composition.config, composition.choices, folder, pictures, composition.allowed)
