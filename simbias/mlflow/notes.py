"""The note of a trial, in markdown: what ran, what came out, how it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from simbias.core import markdown
from simbias.core.messages import counted
from simbias.core.records import Iteration
from simbias.trial import diagnostics as remarks
from simbias.trial.run import Outcome, TrialRecord

if TYPE_CHECKING:
    from simbias.trial.study import Study

SHOWN_ROWS = 40  # MLflow keeps 8000 characters of a note
REASON_LENGTH = 500
ARTIFACTS = (
    "Artifacts: `config.yaml`, `policies/`, `parameters/` (identified), `experiments/` (hardware, as npz), "
    "`data/` (what was learned from, after each iteration), `pictures/` (with `tracking.pictures`)."
)


@dataclass(frozen=True)
class Row:
    """What the note says of an iteration."""

    index: int
    predicted_cost: float | None
    hardware_cost: float
    samples: int
    seconds: float
    event: str
    succeeded: bool
    total_experiments: int


def row(study: Study, iteration: Iteration, earlier: Sequence[Iteration]) -> Row:
    """The iteration, as the note's table shows it, after earlier ones."""
    return Row(
        index=iteration.index,
        predicted_cost=iteration.search.predicted_cost if iteration.search else None,
        hardware_cost=iteration.hardware_cost,
        samples=len(iteration.learning.data) if iteration.learning else 0,
        seconds=sum(iteration.seconds.values()),
        event="; ".join(_events(study, iteration, earlier)),
        succeeded=iteration.succeeded,
        total_experiments=iteration.total_experiments,
    )


def _events(study: Study, iteration: Iteration, earlier: Sequence[Iteration]) -> list[str]:
    """What happened in an iteration, in words."""
    failures = [
        rollout.failure or "failed" for rollout in iteration.experiments if rollout.failed_at is not None
    ]
    events = ["**succeeded**"] if iteration.succeeded else []
    if failures:
        causes = ", ".join(study.task.words(name) for name in dict.fromkeys(failures))
        made = counted(len(iteration.experiments), "experiment")
        events.append(f"{len(failures)} of {made} failed: {markdown.text(causes)}")
    if iteration.learning and iteration.learning.reset:
        events.append("model cleared")
    return [*events, *map(markdown.text, remarks.of_iteration(iteration, earlier))]


def run_name(study: Study) -> str:
    """The name of a trial's run."""
    return f"{study.choices['bias']} {study.choices['optimizer']} seed {study.seed}"


def note(study: Study, rows: Sequence[Row], verdict: str) -> str:
    """The note: the verdict, the trial, a row for each iteration (the last ones, if there are many)."""
    parts = [verdict, f"{markdown.text(study.title)}. Seed {study.seed}, trial `{study.hash}`."]
    if rows:
        parts.append(_table(rows[-SHOWN_ROWS:]))
    if len(rows) > SHOWN_ROWS:
        parts.append(f"The {len(rows) - SHOWN_ROWS} iterations before these are among the metrics.")
    return "\n\n".join([*parts, ARTIFACTS])


def _table(rows: Sequence[Row]) -> str:
    """A markdown table of iterations."""
    head = "| iteration | predicted cost | hardware cost | samples | seconds | what happened |\n"
    return f"{head}|--:|--:|--:|--:|--:|:--|\n" + "\n".join(
        f"| {r.index} | {'' if r.predicted_cost is None else f'{r.predicted_cost:.4g}'} "
        f"| {r.hardware_cost:.4g} | {r.samples} | {r.seconds:.1f} | {r.event} |"
        for r in rows
    )


def running(rows: Sequence[Row]) -> str:
    """The verdict before the end."""
    return f"**Running**, after {_count(rows, 0)}."


def verdict(rows: Sequence[Row], record: TrialRecord) -> str:
    """How a trial ended."""
    count, reason = _count(rows, len(record.unfinished)), record.reason[:REASON_LENGTH]
    worth = f" {record.held_out.words}" if record.held_out else ""
    if record.outcome is Outcome.SUCCEEDED:
        return f"**Succeeded** on hardware in iteration {rows[-1].index}, after {count}.{worth}"
    if record.outcome is Outcome.NOT_SUCCEEDED:
        return f"**Did not succeed**: no policy reached the goal on hardware, after {count}.{worth}"
    if record.outcome is Outcome.WAITING:
        return f"**Waiting**, after {count}: {markdown.text(reason)}"
    if record.outcome is Outcome.INTERRUPTED:
        return f"**Interrupted**, after {count}."
    return f"**Ended with an error**, after {count}: {markdown.code(reason)} (`error.txt`)"


def _count(rows: Sequence[Row], unfinished: int) -> str:
    """How far the trial came."""
    experiments = (rows[-1].total_experiments if rows else 0) + unfinished
    text = f"{counted(len(rows), 'iteration')} and {counted(experiments, 'hardware experiment')}"
    return f"{text}, {unfinished} of them in an iteration that did not end" if unfinished else text
