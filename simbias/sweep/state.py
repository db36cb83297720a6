"""The state of a running sweep: its trials so far, in its folder and exported from there."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from pandas import DataFrame

from simbias.config.build import build
from simbias.core import markdown
from simbias.core.errors import ConfigError
from simbias.core.interruption import deferred
from simbias.core.messages import redact
from simbias.sweep import results, tables
from simbias.sweep.figure import SweptTrials
from simbias.sweep.grid import Sweep, Trial
from simbias.sweep.tracking import Export, Tracking
from simbias.sweep.worker import GONE, PlannedTrial, Result, code, goes_on, pack, unpack
from simbias.trial.folder import TakenError, TrialFolder
from simbias.trial.origin import provenance, tell_what_is_in_clear
from simbias.trial.run import TrialRecord, read_trial
from simbias.trial.summary import Outcome, TrialSummary

DAMAGED = "simbias: %s; the trial counts as unfinished"
MIXED = "simbias: trials of this sweep are from %d platforms, so their last bits may differ: %s"
PART = (
    "simbias: running %d of the %d trials of %s: its tables, figures and page still show all. To show only "
    "these, delete that folder; trials are kept in other folders"
)
LOSES = "simbias: %s drops %d of its %d trials, which are no longer part of the sweep; their folders stay"
MEANWHILE = (
    "simbias: trial %s was run here, or an experiment withdrawn, meanwhile: its worker's result is dropped"
)
# First words about a sweep.
RUNNING, DONE, INTERRUPTED = "**Running**", "**Done**", "**Interrupted**"
WAITS = "**Waiting** for hardware experiments or another process"
MARKER = ".shared_"  # prefix of a file that only workers with a shared disk see
STATE_SECONDS = 5.0  # maximum age of the sweep's state while trials end,
STATE_SHARE = 0.02  # unless it would take more than this of the time
IN_SWEEPS = ("overview",)  # pictures of a cell's first trial; the others take long


def finished(sweep: Sweep, store: Tracking) -> DataFrame:
    """The trials of a sweep that have ended and have their pictures."""
    return _whole(results.of_folders(sweep, store.folder), store)


def _whole(trials: DataFrame, store: Tracking) -> DataFrame:
    """Trials that have ended and have their pictures; a kill may have prevented the latter."""
    ended = trials[trials["outcome"] != Outcome.ERROR]
    drawn = [
        not _pictures(repetition, store) or TrialFolder(Path(store.folder or "", identity)).illustrated
        for identity, repetition in zip(ended["hash"], ended["repetition"], strict=True)
    ]
    return ended.loc[drawn]


def _pictures(repetition: int, store: Tracking) -> tuple[str, ...]:
    """The pictures of a trial; only a cell's first trial has some, as an example."""
    return IN_SWEEPS if store.pictures and not repetition else ()


class SweepState:
    """A sweep's trials so far; `again` is the command that resumes it."""

    def __init__(self, sweep: Sweep, store: Tracking, again: str) -> None:
        self._sweep, self._store = sweep, store
        self.folder = store.sweep_folder(sweep.name, sweep.hash)
        warn = partial(logging.getLogger(__name__).warning, DAMAGED)
        done = results.of_folders(sweep, store.folder, warn)
        self.finished = _whole(done, store)
        self._rows: dict[str, Mapping[Any, Any]] = {row["hash"]: row for row in done.to_dict("records")}
        ran_on = (
            tuple(TrialFolder(Path(store.folder or "", name)).platforms()) for name in self.finished["hash"]
        )
        self._platforms = Counter(filter(None, ran_on))  # platform -> number of trials
        drawn = self.folder.state().get("captions", {})  # from an earlier run, until redrawn
        self._captions = {name: caption for name, caption in drawn.items() if name in sweep.figures}
        self._drawn = dict(self.folder.state().get("drawn", {}))  # number of trials in each figure
        self._due = 0.0
        self._codes: dict[str, Mapping[str, str]] = {}  # of cells
        self.export = Export()  # shows the sweep elsewhere, once MLflow is imported; never created twice
        tell_what_is_in_clear(sweep.base.from_environment if store.folder else (), self.folder.path)
        asked, recorded = {trial.hash for trial in sweep.trials}, self.folder.trials_recorded()
        made = (TrialFolder(Path(store.folder or "", name)).ended for name in recorded - asked)
        self._partial = asked < recorded and any(made)  # if so, the sweep's folder stays unchanged
        if self._partial:
            logging.getLogger(__name__).warning(PART, len(asked), len(recorded), self.folder.path)
        else:
            if lost := len(recorded - asked):
                logging.getLogger(__name__).warning(LOSES, self.folder.path, lost, len(recorded))
            self.folder.begin(_description(sweep, again))
        for left in self.folder.path.glob(f"{MARKER}*"):  # left by a killed process
            left.unlink()
        self._marker = (self.folder.path / f"{MARKER}{uuid4().hex}").absolute()
        self._marker.touch()

    def begin(self) -> None:
        """Note that trials or figures are about to be made; a finished sweep stays finished."""
        self.export = self._store.export_sweep(self.folder)
        if self.missing or self.folder.state().get("verdict") != DONE:
            self._write(RUNNING)

    @property
    def missing(self) -> list[Trial]:
        """The trials that have not ended."""
        ended = set(self.finished["hash"])
        return [trial for trial in self._sweep.trials if trial.hash not in ended]

    @property
    def waits(self) -> bool:
        """Whether a trial waits for an experiment or runs elsewhere, once none runs here."""
        return len(self._rows) < len(self._sweep.trials)

    @property
    def draws(self) -> bool:
        """Whether figures are made: for a complete sweep without waiting trials, not all with errors."""
        raised = (row["outcome"] == Outcome.ERROR for row in self._rows.values())
        return not self._partial and not self.waits and not all(raised)

    def plan(self, trial: Trial, shares_disk: bool) -> PlannedTrial:
        """A trial as a worker needs it."""
        folder = self._store.trial_folder(trial.hash)
        composition = replace(trial.composition, from_environment=())  # already reported
        digests = None if shares_disk else self._code(trial)
        if folder is None:
            return PlannedTrial(composition, code=digests)
        marker = "" if shares_disk else str(self._marker)
        kept = pack(folder) if marker else b""
        pictures = _pictures(trial.repetition, self._store)
        return PlannedTrial(composition, str(folder.absolute()), marker, kept, pictures, digests)

    def _code(self, trial: Trial) -> Mapping[str, str]:
        """Digests of a trial's code and files, taken at the first trial of its cell."""
        cell = trial.cell.composition.group_hash
        if cell not in self._codes:
            self._codes[cell] = code(build(trial.composition))
        return self._codes[cell]

    def taken_in(self, trial: Trial, result: Result) -> Result:
        """A result, its folder unpacked if a worker sent it; dropped if the trial was run here meanwhile.

        It is also dropped if an experiment of the trial was withdrawn.
        """
        folder = self._store.trial_folder(trial.hash)
        if folder is not None and not self._marker.exists():
            gone = self.folder.path if folder.parent.exists() else folder.parent
            raise ConfigError("tracking", GONE.format(gone))
        if folder is not None and result.packed:
            try:
                with deferred(), TrialFolder(folder).held():
                    if not goes_on(result.packed, folder):
                        logging.getLogger(__name__).warning(MEANWHILE, trial.hash)
                        return Result(TrialSummary(Outcome.RUNNING, reason=MEANWHILE % trial.hash))
                    unpack(result.packed, folder)
            except TakenError as error:
                return Result(TrialSummary(Outcome.RUNNING, reason=str(error)))
        return result

    def keep(self, trial: Trial, result: Result) -> None:
        """Note a trial that ended or stopped, and export it."""
        folder, summary = self._store.trial_folder(trial.hash), result.summary
        self._rows.pop(trial.hash, None)  # a row of a failed attempt
        if summary.outcome in results.SHOWN:
            self._rows[trial.hash] = results.row(trial, self._sweep, summary)
        self._note_platforms(summary)
        if folder is not None:
            self.export.trial_ended(folder)
        if time.monotonic() > self._due:
            self._write(RUNNING)

    def _note_platforms(self, summary: TrialSummary) -> None:
        """Count the platforms; report when a new one appears."""
        if not summary.platforms:
            return
        mixed = bool(self._platforms) and summary.platforms not in self._platforms
        self._platforms[summary.platforms] += 1
        if mixed:
            logging.getLogger(__name__).warning(MIXED, len(self._platforms), self._mixed())

    def _mixed(self) -> str:
        """The platforms and their numbers of trials."""
        return "; ".join(f"{count} on {' then '.join(each)}" for each, count in self._platforms.items())

    def results(self) -> DataFrame:
        """The trials that ended or raised an error."""
        return results.in_order(self._rows, self._sweep)

    def swept(self) -> SweptTrials:
        """The trials for figures; each can be read back in full."""
        trials = {trial.hash: trial for trial in self._sweep.trials}

        def load(identity: str) -> TrialRecord:
            return read_trial(build(trials[identity].composition), Path(self._store.folder or "", identity))

        return SweptTrials(self._sweep, self.results(), load)

    def publish(self, name: str, caption: str, files: Sequence[Path]) -> None:
        """Keep a figure and its caption."""
        self._captions[name], self._drawn[name] = caption, len(self._rows)
        self.folder.publish(files)

    def close(self, error: BaseException | None = None) -> None:
        """Write how the sweep ended; the error says why it ended early."""
        try:
            self._write(self._verdict(error), final=True)
        except Exception:
            if error is None:
                raise  # otherwise the cause, such as a full disk, may also prevent this
        finally:
            self._marker.unlink(missing_ok=True)

    def _verdict(self, error: BaseException | None) -> str:
        """First words about a sweep that ended."""
        if error is not None:
            interrupted = isinstance(error, KeyboardInterrupt | SystemExit)
            return INTERRUPTED if interrupted else "**Ended early** by an error"
        raised = "error" in set(self.results()["outcome"])
        return WAITS if self.waits else "**Ended**, some trials with an error" if raised else DONE

    def _write(self, verdict: str, final: bool = False) -> None:
        """Write the sweep's progress, and export it."""
        began = time.monotonic()
        trials, sweep = self.results(), self._sweep
        table = tables.cells(trials, sweep)
        arrangement = markdown.table(*tables.layout(table, sweep))
        state = {
            "verdict": verdict,
            "done": len(trials),
            "trials": len(sweep.trials),
            "outcomes": dict(Counter(trials["outcome"])),
            "digest": results.digest(self._rows),
            "mean_experiments": None if trials["experiments"].isna().all() else trials["experiments"].mean(),
            "platforms": self._mixed() if len(self._platforms) > 1 else "",
            "table": arrangement,
            "legend": tables.legend(sweep, trials),
            "captions": self._captions,
            "drawn": self._drawn,
        }
        files = {"trials.csv": results.csv(trials), "table.md": arrangement}
        files["table.csv"] = table.to_csv(index=False)
        if not self._partial:
            self.folder.write_state(state, files if final else {})
        self.export.update(final)
        ended = time.monotonic()
        self._due = ended + max(STATE_SECONDS, (ended - began) / STATE_SHARE)


def _description(sweep: Sweep, again: str) -> dict[str, Any]:
    """A sweep in JSON's types."""
    axes = [axis.name for axis in sweep.axes]
    return {
        "name": sweep.name,
        "hash": sweep.hash,
        "command": redact(again, str(sweep.base.config.get("tracking", {}).get("uri", ""))),
        "config": {key: value for key, value in sweep.base.config.items() if key != "tracking"},
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
