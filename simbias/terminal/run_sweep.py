"""A sweep in the terminal: what is missing of it is run, or told; its exit status."""

from __future__ import annotations

import sys

from simbias.config import Composition, ConfigError, Variations
from simbias.config.build import service
from simbias.core.commands import FAILED, INTERRUPTED, SUCCEEDED, WAITING
from simbias.engine.contract import Engine, EngineLostError
from simbias.mlflow.store import cause
from simbias.sweep import running
from simbias.sweep.tracking import Tracking
from simbias.terminal.notices import preparing, slowness_in_one_line
from simbias.terminal.sweep import SweepConsole, dry_run


def run(variations: Variations, composition: Composition, again: str) -> int:
    """Run what is missing of a sweep, or tell what that is; `again` is the command that does."""
    trials_engine: Engine = service(composition, "engine", Engine)
    store: Tracking = service(composition, "tracking", Tracking)
    with preparing(), slowness_in_one_line():
        sweep, finished = running.prepare(store, variations)
    if sweep.dry_run:
        dry_run(sweep, finished, trials_engine)
        return SUCCEEDED
    console = SweepConsole()
    for changed in running.changed_trials(sweep, store):
        print(f"simbias: {changed}", file=sys.stderr)
    try:
        trials, where = running.run_sweep(sweep, trials_engine, store, again, console)
    except KeyboardInterrupt:
        console.stopped("interrupted", again)
        return INTERRUPTED
    except EngineLostError as error:
        console.stopped(str(error), again)
        return FAILED
    except ConfigError:
        raise
    except Exception as error:  # of the store or the engine: what a trial raises is in its record
        console.stopped(f"{type(error).__name__}: {cause(error)}", again)
        return FAILED
    console.conclude(trials, where)
    if console.waiting:
        return WAITING
    return FAILED if (trials["outcome"] == "error").any() else SUCCEEDED
