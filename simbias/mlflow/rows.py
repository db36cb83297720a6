"""What is needed of runs in a store; rows that somebody changed by hand are told once, and passed over."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from simbias.mlflow.fields import CODE, HELD_OUT, LATER_METRICS, MACHINE, TRIAL_METRICS
from simbias.trial.run import Outcome

if TYPE_CHECKING:
    from mlflow.entities import Run

FINISHED = "FINISHED"  # a run whose trial came to its end, and is kept in whole
OUTCOMES = frozenset(outcome for outcome in Outcome if outcome.final)  # of such a run
TAGS = ("hash", "outcome", "error", CODE, HELD_OUT, MACHINE)
METRICS = (*TRIAL_METRICS, *LATER_METRICS)


class RunRow(NamedTuple):
    """A trial's run."""

    run_id: str
    status: str
    end_time: int | None  # ms since the epoch
    tags: Mapping[str, str]  # of TAGS
    metrics: Mapping[str, float]  # of METRICS


def row_of(run: Run) -> RunRow:
    """Of a run as MLflow reads it."""
    tags = {key: value for key, value in run.data.tags.items() if key in TAGS}
    metrics = {key: value for key, value in run.data.metrics.items() if key in METRICS}
    return RunRow(run.info.run_id, run.info.status, run.info.end_time, tags, metrics)


def is_whole(run: RunRow) -> bool:
    """Whether a trial's run has all that simbias writes."""
    lacking = [] if "hash" in run.tags else ["tag hash"]
    if run.status == FINISHED:
        lacking += [] if run.tags.get("outcome") in OUTCOMES else ["tag outcome"]
        lacking += [f"metric {name}" for name in TRIAL_METRICS if name not in run.metrics]
        lacking += [] if run.end_time else ["end"]
    if lacking:
        _tell(run.run_id, ", ".join(lacking))
    return not lacking


def is_finished(run: RunRow) -> bool:
    """Whether a run holds a trial that came to its end."""
    return run.status == FINISHED and is_whole(run)


@cache
def _tell(run_id: str, lacking: str) -> None:
    """One line, once."""
    logging.getLogger(__name__).warning(
        "simbias: run %s lacks its %s, as if changed by hand; the trial is run again", run_id, lacking
    )
