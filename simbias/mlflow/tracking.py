"""Trials in folders, exported to an MLflow store: live, later, or again."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path

from simbias.core.errors import ConfigError
from simbias.core.messages import counted
from simbias.mlflow.runs import EXPERIMENT, URI, Runs, readable
from simbias.mlflow.store import database, reaching, trials_beside
from simbias.mlflow.sweep import SweepRun
from simbias.mlflow.trial import TrialExport
from simbias.mlflow.ui import show
from simbias.sweep.folder import SWEEP, SweepFolder, sweep_folders
from simbias.sweep.tracking import Export, Tracking
from simbias.trial.folder import ATTEMPTS, TRIAL, TrialFolder
from simbias.trial.step_files import check_steps


class Mlflow(Tracking):
    """Trials in folders, exported to an MLflow store.

    Parameters
    ----------
    uri
        MLflow's store: a database or, for several machines, a server's address. The artifacts of a SQLite
        store lie in `mlartifacts` beside it; those of another database in a folder of one machine.
    experiment
        MLflow's experiment, which holds the runs; created if necessary.
    pictures
        Whether pictures are drawn for each finished trial; in sweeps, for the first trial of each cell.
    trials
        Folder of the trials; None: `trials` beside a SQLite store's database, else in the working folder.
    """

    def __init__(
        self,
        uri: str = URI,
        experiment: str = EXPERIMENT,
        pictures: bool = True,
        trials: str | None = None,
    ) -> None:
        if not experiment.isprintable() or set(experiment.strip()) <= {"."}:
            raise ValueError("experiment must be a name that can be printed, and no dots alone")
        self._uri = uri
        self._experiment = experiment
        self._trials = trials
        self.pictures = pictures
        self.unshown = 0  # trials and sweeps that `export` could not export, or found damaged

    @cached_property
    def folder(self) -> Path:  # type: ignore[override]
        """The folder of all trials."""
        return Path(self._trials) if self._trials else trials_beside(self._uri)

    @cached_property
    def _runs(self) -> Runs:
        """The store's runs."""
        return Runs(self._uri, self._experiment, self.folder)

    def export_trial(self, folder: Path) -> Export:
        """The trial's run."""
        return TrialExport(self._runs, folder)

    def export_sweep(self, folder: SweepFolder) -> Export:
        """The sweep's run, and a nested run for each trial."""
        return SweepRun(self._runs, folder)

    def show(self, identity: str | None, port: int | None) -> None:
        """Open MLflow at the run with this hash, or at the list of all; Ctrl-C ends a local server.

        ConfigError if there is no such store or run.
        """
        file = database(self._uri)
        if file is not None and not file.exists():
            raise ConfigError("tracking.uri", f"{self._uri}: no such store")
        with reaching(self._uri):
            page = self._runs.page(identity)
        show(self._uri, page, port)

    def export(self, folder: Path | None = None) -> Iterator[str]:
        """Export a trial, a sweep or a folder of trials, by default the store's.

        Yield a line for each sweep, and one for other trials; a trial of a sweep is exported with the sweep.
        Unreadable and damaged ones, and copies beside their trials, are reported and counted in `unshown`.
        ConfigError if there are none, or the store cannot be used; what was exported before stays.
        """
        folders, sweeps = _trials_and_sweeps(folder or self.folder)
        in_sweeps, every = set[str](), set(folders)
        with reaching(self._uri):
            for sweep in sweeps:
                run = SweepRun(self._runs, sweep)
                if not readable(partial(run.write, final=True)):
                    self.unshown += 1
                    with suppress(ConfigError):
                        in_sweeps |= sweep.trials_recorded()
                    continue
                about = sweep.description()
                in_sweeps |= about["trials"].keys()
                every |= {sweep.trials / identity for identity in about["trials"]}
                self.unshown += run.shown.count(False)
                yield f"sweep {about['name']}: {sum(run.shown)} of {counted(len(about['trials']), 'trial')}"
            alone = [each for each in folders if each.name not in in_sweeps]
            exported = sum(readable(partial(self._write_alone, each)) for each in alone)
            self.unshown += len(alone) - exported
            self.unshown += sum(_damaged(each) for each in sorted(every))
            if folders:
                yield f"{counted(exported, 'trial')} in no sweep"

    def _write_alone(self, folder: Path) -> None:
        """Export a trial outside of sweeps; ConfigError for a copy, whose run would count the trial twice."""
        identity = str(TrialFolder(folder).description().get("hash"))
        if identity != folder.name and (folder.parent / identity / TRIAL).exists():
            raise ConfigError(str(folder), f"is a copy of trial {identity}, which lies beside it")
        TrialExport(self._runs, folder).write()


def _damaged(folder: Path) -> bool:
    """Whether a trial's steps are damaged, although it may be shown; a line says what is."""
    try:
        check_steps(TrialFolder(folder))
    except ConfigError as error:
        logging.getLogger(__name__).warning("simbias: a trial is damaged: %s", error)
        return True
    return False


def _trials_and_sweeps(folder: Path) -> tuple[list[Path], list[SweepFolder]]:
    """The folders of trials and sweeps that a folder is, or contains; ConfigError if there are none."""
    place = Path(os.path.abspath(folder))  # its name and parents are needed, also of "."
    if (place / TRIAL).is_file():
        return [place], [each for each in sweep_folders(place.parent) if _records(each, place.name)]
    if (place / SWEEP).is_file():
        return [], [SweepFolder(place)]
    trials = sorted({file.parent for name in (TRIAL, ATTEMPTS) for file in folder.glob(f"*/{name}")})
    if not trials:
        raise ConfigError(str(folder), "is not the folder of a trial, of a sweep or of trials")
    return trials, sweep_folders(folder)


def _records(sweep: SweepFolder, trial: str) -> bool:
    """Whether a sweep contains the trial with this hash; an unreadable one does not."""
    with suppress(ConfigError):
        return trial in sweep.trials_recorded()
    return False
