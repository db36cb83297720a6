"""Rows of a store that somebody changed by hand: told once, and passed over."""

from __future__ import annotations

import logging
from functools import cache
from typing import TYPE_CHECKING

from simbias.tracking.fields import SECONDS
from simbias.trial import Outcome

if TYPE_CHECKING:
    from mlflow.entities import Run

FINISHED = "FINISHED"  # a run whose trial came to its end, and is kept in whole
OUTCOMES = frozenset(outcome for outcome in Outcome if outcome.final)  # of such a run
METRICS = ("trial/experiments", "trial/iterations", SECONDS)  # likewise


def is_whole(run: Run) -> bool:
    """Whether a trial's run has all that simbias writes."""
    lacking = [] if "hash" in run.data.tags else ["tag hash"]
    if run.info.status == FINISHED:
        lacking += [] if run.data.tags.get("outcome") in OUTCOMES else ["tag outcome"]
        lacking += [f"metric {name}" for name in METRICS if name not in run.data.metrics]
        lacking += [] if run.info.end_time else ["end"]
    if lacking:
        _tell(run.info.run_id, ", ".join(lacking))
    return not lacking


def is_finished(run: Run) -> bool:
    """Whether a run holds a trial that came to its end."""
    return run.info.status == FINISHED and is_whole(run)


@cache
def _tell(run_id: str, lacking: str) -> None:
    """One line, once."""
    logging.getLogger(__name__).warning(
        "simbias: run %s lacks its %s, as if changed by hand; the trial is run again", run_id, lacking
    )
