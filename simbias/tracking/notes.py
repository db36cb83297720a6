"""The note of a trial, in markdown: what ran, what came out, how it ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from simbias.records import Iteration

if TYPE_CHECKING:
    from simbias.study import Study

SHOWN_ROWS = 40  # MLflow keeps 8000 characters of a note
ERROR_LENGTH = 500
INTERRUPTIONS = (KeyboardInterrupt, SystemExit, GeneratorExit)
ARTIFACTS = (
    "Artifacts: `config.yaml`, `policies/`, `experiments/` (hardware, as npz), "
    "`data/` (what was learned from, after each iteration), `pictures/` (with `tracking.pictures`)."
)


@dataclass(frozen=True)
class Row:
    """What the note says of an iteration."""

    index: int
    predicted_cost: float
    hardware_cost: float
    samples: int
    seconds: float
    event: str
    succeeded: bool
    total_experiments: int


def row(iteration: Iteration) -> Row:
    """The iteration, as the note's table shows it."""
    return Row(
        index=iteration.index,
        predicted_cost=iteration.predicted_cost,
        hardware_cost=iteration.hardware_cost,
        samples=len(iteration.data),
        seconds=sum(iteration.seconds.values()),
        event="; ".join(_events(iteration)),
        succeeded=iteration.succeeded,
        total_experiments=iteration.total_experiments,
    )


def _events(iteration: Iteration) -> list[str]:
    """What happened in an iteration, in words."""
    failures = [r.failure or "failed" for r in iteration.experiments if r.failed_at is not None]
    events = ["**succeeded**"] if iteration.succeeded else []
    if failures:
        causes = ", ".join(dict.fromkeys(failures)).replace("|", "/")
        events.append(f"{len(failures)} of {len(iteration.experiments)} experiments failed: {causes}")
    return [*events, "model cleared"] if iteration.model_reset else events


def run_name(study: Study) -> str:
    """The name of a trial's run."""
    return f"{study.choices['bias']} {study.choices['optimizer']} seed {study.seed}"


def note(study: Study, rows: Sequence[Row], verdict: str) -> str:
    """The note: the verdict, the trial, a row for each iteration (the last ones, if there are many)."""
    parts = [verdict, f"{study.title}. Seed {study.seed}, trial `{study.hash}`."]
    if rows:
        parts.append(_table(rows[-SHOWN_ROWS:]))
    if len(rows) > SHOWN_ROWS:
        parts.append(f"The {len(rows) - SHOWN_ROWS} iterations before these are among the metrics.")
    return "\n\n".join([*parts, ARTIFACTS])


def _table(rows: Sequence[Row]) -> str:
    """A markdown table of iterations."""
    head = "| iteration | predicted cost | hardware cost | samples | seconds | what happened |\n"
    return f"{head}|--:|--:|--:|--:|--:|:--|\n" + "\n".join(
        f"| {r.index} | {r.predicted_cost:.4g} | {r.hardware_cost:.4g} | {r.samples} | {r.seconds:.1f} "
        f"| {r.event} |"
        for r in rows
    )


def running(rows: Sequence[Row]) -> str:
    """The verdict before the end."""
    return f"**Running**, after {_count(rows, 0)}."


def outcome(rows: Sequence[Row], error: BaseException | None) -> str:
    """How a trial ended, in one word or two: a tag to filter by."""
    if error is not None:
        return "interrupted" if isinstance(error, INTERRUPTIONS) else "error"
    return "succeeded" if rows and rows[-1].succeeded else "not succeeded"


def verdict(rows: Sequence[Row], error: BaseException | None, unfinished: int) -> str:
    """How a trial ended; `unfinished` hardware experiments belong to an iteration that did not end."""
    count = _count(rows, unfinished)
    ending = outcome(rows, error)
    if ending == "succeeded":
        return f"**Succeeded** on hardware in iteration {rows[-1].index}, after {count}."
    if ending == "not succeeded":
        return f"**Did not succeed**: no policy reached the goal on hardware, after {count}."
    if ending == "interrupted":
        return f"**Interrupted**, after {count}."
    return f"**Ended with an error**, after {count}: {_error_text(error)} (`error.txt`)"


def _count(rows: Sequence[Row], unfinished: int) -> str:
    """How far the trial came."""
    experiments = (rows[-1].total_experiments if rows else 0) + unfinished
    text = f"{_plural(len(rows), 'iteration')} and {_plural(experiments, 'hardware experiment')}"
    return f"{text}, {unfinished} of them in an iteration that did not end" if unfinished else text


def _plural(count: int, thing: str) -> str:
    """A count of things."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def _error_text(error: BaseException | None) -> str:
    """An error as one line of code."""
    message = " ".join(str(error).split()).replace("`", "'")[:ERROR_LENGTH]
    return f"`{type(error).__name__}: {message}`" if message else f"`{type(error).__name__}`"
