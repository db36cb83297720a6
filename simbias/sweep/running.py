"""Running a sweep: what is missing is run and kept, trial by trial."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from simbias.config import ConfigError
from simbias.config.build import build
from simbias.interfaces import Engine, TrackedSweep, WorkerLostError
from simbias.pictures.sweep.making import make_figures
from simbias.study import Study
from simbias.sweep.grid import Sweep, Trial, expand
from simbias.sweep.interruption import Interruption, stopping_workers
from simbias.terminal.sweep import SweepConsole
from simbias.worker import TrialRecord, lost, run_plan


def prepare(overrides: Sequence[str], config_dir: Path | str | None = None) -> tuple[Sweep, Study]:
    """The sweep and the study of its first cell, once the components of every cell could be built.

    Raises
    ------
    ConfigError
        If anything is bad about the sweep or one of its cells; nothing has run then.
    """
    sweep = expand(overrides, config_dir)
    studies: dict[tuple[str, ...], Study] = {}
    for cell in sweep.cells:
        try:
            study = build(cell.composition)
        except ConfigError as error:
            where = f" (in the cell {' '.join(cell.labels)})" if cell.labels else ""
            raise ConfigError("", f"{error}{where}") from error
        studies.setdefault(tuple(sorted(cell.composition.choices.values())), study)
    for study in studies.values():  # compiled here once, workers find it in the cache
        study.warm_up()
    return sweep, next(iter(studies.values()))


def run_sweep(sweep: Sweep, engine: Engine, tracked: TrackedSweep, console: SweepConsole) -> None:
    """Run the trials that are not finished, and keep each as it ends; then make the figures.

    Raises
    ------
    KeyboardInterrupt
        On SIGINT or SIGTERM, between two trials; what has ended is kept.
    FigureError
        If a figure cannot be drawn from what there is.
    """
    missing = [trial for trial in sweep.trials if trial.hash not in tracked.finished]
    try:
        with Interruption() as interruption:
            with console:
                for trial, record in _records(engine, missing):
                    with interruption.deferred():
                        tracked.keep(trial, build(trial.composition), record)
                        console.ended(trial, record)
            make_figures(sweep, engine, tracked, console, interruption)
    except BaseException as error:
        tracked.close(error)
        raise
    tracked.close()


def _records(engine: Engine, trials: Sequence[Trial]) -> Iterator[tuple[Trial, TrialRecord]]:
    """Trials with their records, as they end."""
    plans = [(trial.composition.config, trial.composition.choices) for trial in trials]
    with stopping_workers(engine.run(run_plan, plans)) as results:
        for index, result in results:
            yield trials[index], lost(str(result)) if isinstance(result, WorkerLostError) else result
