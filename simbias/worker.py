"""A trial as a pure function: plain config in, plain records out. This is what runs in a sweep's workers."""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from threadpoolctl import threadpool_limits

from simbias.config import Composition
from simbias.config.build import build
from simbias.interfaces import SlowWarning
from simbias.records import Iteration

Plan = tuple[Mapping[str, Any], Mapping[str, str]]  # a composition's config and choices


class TrialError(RuntimeError):
    """What a trial raised in a worker: its type and message, the traceback as a note."""


@dataclass(frozen=True)
class TrialRecord:
    """What a trial did."""

    iterations: tuple[Iteration, ...]  # without fitted biases: they are heavy, and follow from the data
    error: str | None  # what it raised: type and message
    traceback: str
    started: float  # s since the epoch
    seconds: float  # wall time, without the pictures
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # files by name

    @property
    def succeeded(self) -> bool:
        """Whether a policy succeeded on hardware."""
        return self.error is None and bool(self.iterations) and self.iterations[-1].succeeded

    @property
    def exception(self) -> TrialError | None:
        """The error, to be raised or recorded here."""
        if self.error is None:
            return None
        error = TrialError(self.error)
        error.add_note(self.traceback)
        return error


def run_plan(plan: Plan) -> TrialRecord:
    """Run a trial to its end, its linear algebra on one thread; an exception of its is part of the record.

    The number of threads changes the last bits of a factorisation, so a trial that is to give the same
    everywhere has one everywhere.
    """
    started, start = time.time(), time.perf_counter()
    iterations: list[Iteration] = []
    drawn: Mapping[str, bytes] = {}
    error, trace = None, ""
    with threadpool_limits(1, user_api="blas"), warnings.catch_warnings():
        warnings.simplefilter("ignore", SlowWarning)  # a line for each fit of each trial is too many
        try:
            study = build(Composition(*plan))
            for iteration in study.run():
                iterations.append(iteration)
        except Exception as raised:
            error = ": ".join(filter(None, [type(raised).__name__, str(raised)]))
            trace = traceback.format_exc()
        seconds = time.perf_counter() - start
        if error is None and study.tracking.pictures:
            from simbias.pictures.trial.gallery import IN_SWEEPS, pictures  # lazily: not everyone wants any

            drawn = pictures(study, iterations, IN_SWEEPS)
    light = tuple(replace(iteration, fitted_bias=None) for iteration in iterations)
    return TrialRecord(light, error, trace, started, seconds, drawn)


def lost(reason: str) -> TrialRecord:
    """The record of a trial whose workers died."""
    return TrialRecord((), f"WorkerLostError: {reason}", "", time.time(), 0.0)
