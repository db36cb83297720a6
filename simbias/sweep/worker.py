"""What runs in a sweep's workers: a plain config in, a trial's record out."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from simbias.config import Composition
from simbias.config.build import build
from simbias.core import SlowWarning
from simbias.core.messages import with_type
from simbias.core.records import Iteration
from simbias.trial.journal import Journal
from simbias.trial.run import Outcome, Recorder, TrialRecord, run_trial


class Plan(NamedTuple):
    """A trial, in plain containers."""

    config: Mapping[str, Any]
    choices: Mapping[str, str]
    journal: str | None = None  # the folder in which it is kept while it runs
    pictures: tuple[str, ...] = ()  # to draw at its end
    allowed: tuple[str, ...] = ()  # modules of which the config may name classes


def run_plan(plan: Plan) -> TrialRecord:
    """Run a trial, or go on with it, and tell of it in what can be sent: no fitted bias, which is heavy."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SlowWarning)  # a line for each fit of each trial is too many
        try:
            study = build(Composition(plan.config, plan.choices, plan.allowed))
            recorder = Journal(Path(plan.journal), plan.pictures) if plan.journal else Recorder()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            return lost(with_type(error))
        record = run_trial(study, recorder)
        if plan.pictures:
            from simbias.pictures.trial.gallery import illustrated  # lazily: most trials have none

            record = illustrated(study, record, recorder)
    return replace(record, iterations=tuple(map(_light, record.iterations)))


def _light(iteration: Iteration) -> Iteration:
    """An iteration without its fitted bias, which follows from the data."""
    if iteration.search is None:
        return iteration
    return replace(iteration, search=replace(iteration.search, fitted_bias=None, nominal=None))


def lost(reason: str) -> TrialRecord:
    """The record of a trial that could not even begin, or whose workers died; its journal has what it did."""
    return TrialRecord(Outcome.ERROR, (), reason=reason, started=time.time())
