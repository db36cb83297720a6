"""Running a sweep: trials whose folders have no outcome are run, then its figures are made."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from pandas import DataFrame

from simbias.config import ConfigError, Variations
from simbias.config.build import build
from simbias.config.sent_code import packed
from simbias.core.messages import redact
from simbias.engine.contract import Engine, WorkerLostError
from simbias.sweep import results, tables
from simbias.sweep.figure import SweptTrials
from simbias.sweep.grid import Sweep, Trial, expanded
from simbias.sweep.interruption import Interruption, stopping_workers
from simbias.sweep.making import FigureObserver, make_figures
from simbias.sweep.services import engine, tracking
from simbias.sweep.tracking import Export, Tracking
from simbias.sweep.worker import GONE, Plan, Result, lost, pack, run_plan, unpack
from simbias.testing.rehearsal import rehearse
from simbias.trial.disk import LOCK, locked
from simbias.trial.folder import PICTURES, TrialFolder
from simbias.trial.origin import changed_code, provenance, tell_what_is_in_clear
from simbias.trial.run import TrialRecord, read_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome, TrialSummary

DAMAGED = "simbias: %s; the trial is run again"
MIXED = "simbias: trials of this sweep are from %d platforms, so their last bits may differ: %s"
DONE = "**Done**"  # first words on a sweep without an error
MARKER = ".shared_"  # prefix of a file that only workers on the same disk see
STATE_SECONDS = 5.0  # the sweep's state is at most so old while trials end,
STATE_SHARE = 0.02  # unless it would take more than this of the time
IN_SWEEPS = ("overview",)  # pictures of a cell's first trial; the others take long


class SweepObserver(FigureObserver):
    """Follows a sweep; this one does nothing."""

    def begun(self, sweep: Sweep, finished: DataFrame, keeps: bool) -> None:
        """The trials begin, but for those that are finished; `keeps` tells whether any is kept."""

    def ended(self, trial: Trial, result: Result) -> None:
        """A trial has ended or stopped, and is kept."""

    def all_ended(self) -> None:
        """No trial runs any more, for whatever reason."""


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
    return run_sweep(sweep, trials_engine, store, f"simbias.run_sweep({list(overrides)!r})", observer)[0]


def prepare(store: Tracking, variations: Variations) -> tuple[Sweep, Study, DataFrame]:
    """The sweep, the study of its first cell, and the trials that are finished.

    The components of every cell could be built. Where trials are missing, the simulation is compiled.

    Raises
    ------
    ConfigError
        If anything is bad about the sweep or one of its cells; nothing has run then.
    """
    sweep = expanded(variations)
    for name, figure in sweep.figures.items():
        if store.folder is None and figure.reads_trials:
            raise ConfigError("tracking", f"none keeps no trials, which sweep.figures.{name} reads")
    studies: dict[tuple[str, ...], Study] = {}
    for cell in sweep.cells:
        try:
            study = build(cell.composition)
        except ConfigError as error:
            where = f" (in the cell {' '.join(cell.labels)})" if cell.labels else ""
            raise ConfigError("", f"{error}{where}") from error
        studies.setdefault(tuple(sorted(cell.composition.choices.values())), study)
    finished = _finished(sweep, store)
    if len(finished) < len(sweep.trials):
        for study in studies.values():  # compiled here once, workers find it in the cache
            rehearse(study)
    return sweep, next(iter(studies.values())), finished


def _finished(sweep: Sweep, store: Tracking) -> DataFrame:
    """The trials of a sweep that have ended."""
    return (
        _done(results.of_folders(sweep, store.folder), store) if store.folder else results.in_order({}, sweep)
    )


def _done(trials: DataFrame, store: Tracking) -> DataFrame:
    """Those trials that have ended, and have their pictures; a kill may have come between."""
    ended = trials[trials["outcome"] != Outcome.ERROR]
    drawn = [
        not _pictures(repetition, store) or Path(store.folder or "", identity, PICTURES).is_dir()
        for identity, repetition in zip(ended["hash"], ended["repetition"], strict=True)
    ]
    return ended.loc[drawn]


def _pictures(repetition: int, store: Tracking) -> tuple[str, ...]:
    """Pictures of a trial: a cell's first trial has some, which stand for all."""
    return IN_SWEEPS if store.pictures and not repetition else ()


def run_sweep(
    sweep: Sweep,
    trials_engine: Engine,
    store: Tracking,
    again: str,
    observer: SweepObserver | None = None,
) -> tuple[DataFrame, str]:
    """Run the trials that have not ended, and make the figures; `again` is the command that resumes.

    Returns the trials, as `simbias.sweep.results` describes them, and how a person looks at them.

    Raises
    ------
    ConfigError
        If the store cannot be used, or another process runs this sweep.
    KeyboardInterrupt
        On SIGINT or SIGTERM, between two trials; what has ended is kept.
    FigureError
        If a figure cannot be drawn from what there is.
    """
    observer = observer or SweepObserver()
    folder = store.sweep_folder(sweep.name, sweep.hash)
    with _alone(folder.path if folder else None):
        state = SweepState(sweep, store, again)
        try:
            with Interruption() as interruption:
                observer.begun(sweep, state.finished, store.folder is not None)
                try:
                    state.begin()
                    for trial, result in _results(trials_engine, state):
                        with interruption.defer():
                            state.keep(trial, result)
                            observer.ended(trial, result)
                finally:
                    observer.all_ended()
                make_figures(sweep, trials_engine, state, observer, interruption)
        except BaseException as error:
            state.close(error)
            raise
        state.close()
        return state.results(), state.export.where


@contextmanager
def _alone(folder: Path | None) -> Iterator[None]:
    """Run a sweep in no other process at the same time."""
    if folder is None:
        yield
        return
    with locked(folder / LOCK, 0.0, ConfigError("sweep", "another process is running this sweep")):
        yield


class SweepState:
    """A sweep that runs: its trials so far, in its folder and exported from there."""

    def __init__(self, sweep: Sweep, store: Tracking, again: str) -> None:
        self._sweep, self._store, self._again = sweep, store, again
        self.folder = store.sweep_folder(sweep.name, sweep.hash)
        done = results.of_folders(sweep, store.folder, _warn) if store.folder else results.in_order({}, sweep)
        self.finished = _done(done, store)
        self._rows: dict[str, Mapping[Any, Any]] = {row["hash"]: row for row in done.to_dict("records")}
        ended = self.finished["hash"] if store.folder else ()
        ran_on = (tuple(TrialFolder(store.folder / name).platforms()) for name in ended)
        self._platforms = Counter(filter(None, ran_on))  # trials of each
        self._captions: dict[str, str] = {}  # of figures
        self._due = 0.0
        self._outcomes: dict[str, Any] = {}  # of batches of experiments, where nothing is kept
        self._marker = ""
        if self.folder is not None:
            tell_what_is_in_clear(sweep.base.from_environment, self.folder.path)
            self.folder.begin(_description(sweep, again))
            for left in self.folder.path.glob(f"{MARKER}*"):  # by a process that was killed
                left.unlink()
            self._marker = str((self.folder.path / f"{MARKER}{uuid4().hex}").absolute())
            Path(self._marker).touch()

    @cached_property
    def export(self) -> Export:
        """Shows the sweep elsewhere."""
        return self._store.export_sweep(self.folder) if self.folder else Export()

    def begin(self) -> None:
        """Note that trials or figures are about to be made; a finished sweep stays so."""
        if self.folder is not None and (self.missing or self.folder.state().get("verdict") != DONE):
            self._write("**Running**")

    @property
    def missing(self) -> list[Trial]:
        """The trials that have not ended."""
        ended = set(self.finished["hash"])
        return [trial for trial in self._sweep.trials if trial.hash not in ended]

    def plan(self, trial: Trial, shares_disk: bool) -> Plan:
        """A trial as a worker needs it."""
        folder = self._store.trial_folder(trial.hash)
        composition = replace(trial.composition, from_environment=())  # which has been told
        if folder is None:
            return Plan(composition)
        return Plan(
            composition,
            str(folder.absolute()),
            "" if shares_disk else self._marker,
            pack(folder) if not shares_disk and TrialFolder(folder).steps() else b"",
            _pictures(trial.repetition, self._store),
        )

    def keep(self, trial: Trial, result: Result) -> None:
        """Note a trial that ended or stopped, and export it."""
        folder, summary = self._store.trial_folder(trial.hash), result.summary
        if folder is not None and result.packed:
            if not Path(self._marker).exists():
                raise ConfigError("tracking", GONE.format(folder.parent))
            unpack(result.packed, folder)
        self._rows.pop(trial.hash, None)  # of an attempt that raised
        if summary.outcome in results.SHOWN:
            self._rows[trial.hash] = results.row(trial, self._sweep, summary)
        self._note_platforms(summary)
        if folder is not None:
            self.export.trial_ended(folder)
        if time.monotonic() > self._due:
            self._write("**Running**")

    def _note_platforms(self, summary: TrialSummary) -> None:
        """Count the platforms; say so when another comes in."""
        if not summary.platforms:
            return
        mixed = bool(self._platforms) and summary.platforms not in self._platforms
        self._platforms[summary.platforms] += 1
        if mixed:
            logging.getLogger(__name__).warning(MIXED, len(self._platforms), self._mixed())

    def _mixed(self) -> str:
        """The platforms and how many trials ran on each."""
        return "; ".join(f"{count} on {' then '.join(each)}" for each, count in self._platforms.items())

    def results(self) -> DataFrame:
        """The trials that ended or raised."""
        return results.in_order(self._rows, self._sweep)

    def swept(self) -> SweptTrials:
        """The trials for figures; each can be read back in full."""
        trials, folder = {trial.hash: trial for trial in self._sweep.trials}, self._store.folder or Path()

        def load(identity: str) -> TrialRecord:
            return read_trial(build(trials[identity].composition), folder / identity)

        return SweptTrials(self._sweep, self.results(), load)

    def outcomes(self, batches: Sequence[str]) -> dict[str, Any]:
        """Those outcomes of batches of experiments that are kept."""
        return self.folder.outcomes(batches) if self.folder else {}

    def keep_outcomes(self, batch: str, outcomes: Any) -> None:
        """Keep the outcomes of a batch of experiments, by its hash."""
        if self.folder is not None:
            self.folder.keep_outcomes(batch, outcomes)

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Keep a figure and its caption."""
        self._captions[name] = caption
        if self.folder is not None:
            self.folder.publish(files)

    def close(self, error: BaseException | None = None) -> None:
        """Write how the sweep ended; the error says why it ended early."""
        try:
            self._write(_verdict(error, "error" in set(self.results()["outcome"])), final=True)
        except Exception:
            if error is None:
                raise  # else what ended the sweep, as a full disk, may well end this too
        finally:
            if self._marker:
                Path(self._marker).unlink(missing_ok=True)

    def _write(self, verdict: str, final: bool = False) -> None:
        """Write how far the sweep is, and export it."""
        began = time.monotonic()
        if self.folder is not None:
            trials, sweep = self.results(), self._sweep
            table = tables.cells(trials, sweep)
            arrangement = tables.markdown(tables.layout(table, sweep))
            state = {
                "verdict": verdict,
                "done": len(trials),
                "trials": len(sweep.trials),
                "outcomes": dict(Counter(trials["outcome"])),
                "mean_experiments": None
                if trials["experiments"].isna().all()
                else trials["experiments"].mean(),
                "platforms": self._mixed() if len(self._platforms) > 1 else "",
                "table": arrangement,
                "legend": tables.legend(sweep, trials),
                "captions": self._captions,
            }
            files = {"trials.csv": results.csv(trials), "table.md": arrangement}
            files["table.csv"] = table.to_csv(index=False)
            self.folder.write_state(state, files if final else {})
        self.export.update(final)
        ended = time.monotonic()
        self._due = ended + max(STATE_SECONDS, (ended - began) / STATE_SHARE)


def _warn(damaged: ConfigError) -> None:
    """Say which folder cannot be read."""
    logging.getLogger(__name__).warning(DAMAGED, damaged)


def _results(trials_engine: Engine, state: SweepState) -> Iterator[tuple[Trial, Result]]:
    """Trials with their results, as they end."""
    trials = state.missing
    plans, cells = (
        [state.plan(trial, trials_engine.shares_disk) for trial in trials],
        {trial.cell.identity: trial for trial in trials},
    )
    code = partial(packed, [trial.composition for trial in cells.values()])
    with stopping_workers(trials_engine.run(run_plan, plans, code)) as ended:
        for index, result in ended:
            yield trials[index], lost(str(result)) if isinstance(result, WorkerLostError) else result


def _description(sweep: Sweep, again: str) -> dict[str, Any]:
    """A sweep in JSON's types."""
    config = {key: value for key, value in sweep.base.config.items() if key != "tracking"}
    axes = [axis.name for axis in sweep.axes]
    return {
        "name": sweep.name,
        "hash": sweep.hash,
        "command": redact(again, str(sweep.base.config.get("tracking", {}).get("uri", ""))),
        "config": config,
        "axes": [{"name": axis.name, "keys": list(axis.keys)} for axis in sweep.axes],
        "trials": {
            trial.hash: {
                "name": trial.name,
                "repetition": trial.repetition,
                "labels": dict(zip(axes, trial.cell.labels, strict=True)),
            }
            for trial in sweep.trials
        },
        **provenance(),
    }


def _verdict(error: BaseException | None, raised: bool) -> str:
    """First words on a sweep that ended."""
    if error is None:
        return "**Ended**, some trials with an error" if raised else DONE
    interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
    return "**Interrupted**" if interrupted else "**Ended early** by an error"


def changed_trials(sweep: Sweep, store: Tracking) -> str:
    """Finished trials that ran on code of the user's that has changed since, in words; "" if none did."""
    if store.folder is None:
        return ""
    studies: dict[str, Study] = {}
    found, finished = [], 0
    for trial in sweep.trials:
        folder = TrialFolder(store.folder / trial.hash)
        if folder.ended:
            finished += 1
            if trial.cell.identity not in studies:
                studies[trial.cell.identity] = build(trial.composition)
            if modules := changed_code(folder.description(), studies[trial.cell.identity]):
                found.append(modules)
    if not found:
        return ""
    return (
        f"{len(found)} of {finished} finished trials ran on code that has changed since ({found[0]}); "
        "tracking.trials=FOLDER begins again"
    )
