"""A trial in the terminal: run as far as it gets, resumed or replayed; its exit status."""

from __future__ import annotations

import sys
from dataclasses import replace

from simbias.config import Composition, ConfigError
from simbias.config.build import build, service
from simbias.core.commands import FAILED, SUCCEEDED, WAITING
from simbias.core.messages import counted, with_type
from simbias.engine.contract import Engine
from simbias.engine.workplace import tidy
from simbias.sweep.tracking import Export, Tracking
from simbias.terminal.notices import preparing, slowness_in_one_line
from simbias.terminal.trial import TrialConsole, changed_since, traceback_file
from simbias.testing.rehearsal import rehearse
from simbias.trial.folder import TrialFolder
from simbias.trial.observer import Observers
from simbias.trial.run import run_trial
from simbias.trial.study import Study
from simbias.trial.summary import Outcome


def run(composition: Composition, again: str) -> int:
    """Run one trial, or resume it; `again` is the command that does."""
    service(composition, "engine", Engine)  # a single trial needs none, but a bad one is bad input
    tidy()  # a trial that has ended makes no folder of its own, which would
    store: Tracking = service(composition, "tracking", Tracking)
    with slowness_in_one_line():
        with preparing():
            study = build(composition)
            rehearse(study)
        return _run_study(study, store, again)


def _run_study(study: Study, store: Tracking, again: str) -> int:
    """Run a trial as far as it gets, resume or replay it."""
    folder = store.trial_folder(study.hash)
    export = store.export_trial(folder) if folder else Export()
    replayed = folder is not None and _ended(TrialFolder(folder))
    if folder is not None and (changed := changed_since(study, folder)):
        print(f"simbias: {changed}", file=sys.stderr)
    try:
        with TrialConsole(study) as console:
            asking = replace(study.conditions, ask=console.ask)  # if it asks at all
            record = run_trial(replace(study, conditions=asking), folder, Observers(console, export))
        if folder is not None and store.pictures:
            from simbias.pictures.trial.gallery import illustrate  # lazily: Matplotlib is not for all

            illustrate(record, folder)
    except (ConfigError, KeyboardInterrupt):
        raise
    except Exception as error:  # of the disk: what a component raises is in the record
        print(f"simbias: {with_type(error)} (resume with:  {again})", file=sys.stderr)
        return FAILED
    finally:
        export.update(final=True)
    summary = record.summary
    if summary.outcome.final:
        console.conclude(record, export.where, replayed)
        return SUCCEEDED if summary.outcome is Outcome.SUCCEEDED else FAILED
    kept = f"{counted(summary.experiments, 'hardware experiment')} kept" if folder else "nothing is kept"
    trace = f"; traceback in {file}" if (file := traceback_file(summary, record.traceback)) else ""
    print(f"simbias: {summary.reason} ({kept}{trace}; resume with:  {again})", file=sys.stderr)
    return WAITING if summary.outcome is Outcome.WAITING else FAILED


def _ended(folder: TrialFolder) -> bool:
    """Whether a trial has ended; an outcome that cannot be read is told, as it follows from the steps."""
    try:
        folder.summary()
    except ConfigError as error:
        print(f"simbias: {error}; it is made again from the steps", file=sys.stderr)
    return folder.ended
