"""The note of a trial's run, in markdown: what ran, what came out, how it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from simbias.core import markdown
from simbias.core.messages import counted
from simbias.trial.folder import Withdrawal
from simbias.trial.summary import COLUMNS, Outcome, TrialSummary, cells

SHOWN_ROWS = 40  # MLflow keeps 8000 characters of a note
REASON_LENGTH = 500
ARTIFACTS = "Artifacts: `config.yaml`, `trial/` (searches, experiments, iterations), `pictures/`."
Row = Mapping[str, Any]  # of an iteration: `simbias.trial.summary.iteration_summary`


def run_name(description: Mapping[str, Any]) -> str:
    """The name of a trial's run."""
    choices = description["choices"]
    return f"{choices['bias']} {choices['optimizer']} seed {description['seed']}"


def note(
    description: Mapping[str, Any],
    rows: Sequence[Row],
    summary: TrialSummary | None,
    running: bool,
    withdrawals: Sequence[Withdrawal] = (),
) -> str:
    """The verdict, the trial, withdrawals, and a row for each iteration, at most the last `SHOWN_ROWS`."""
    verdict = f"**{'Running' if running else 'Killed'}**, after {_count(rows, 0)}."
    parts = [
        verdict if summary is None else _verdict(rows, summary),
        f"{markdown.text(description['title'])}. Seed {description['seed']}, trial `{description['hash']}`.",
    ]
    parts += [f"**Withdrawn**: {markdown.text(str(each))}." for each in withdrawals]
    if rows:
        parts.append(markdown.table(COLUMNS, map(cells, rows[-SHOWN_ROWS:])).rstrip())
    if len(rows) > SHOWN_ROWS:
        parts.append(f"The {len(rows) - SHOWN_ROWS} iterations before these are among the metrics.")
    return "\n\n".join([*parts, ARTIFACTS])


def _verdict(rows: Sequence[Row], summary: TrialSummary) -> str:
    """How a trial ended or stopped."""
    made = rows[-1]["total_experiments"] if rows else 0
    count, reason = _count(rows, summary.experiments - made), summary.reason[:REASON_LENGTH]
    test = f" {summary.test_words}" if summary.test_episodes else ""
    if summary.outcome is Outcome.SUCCEEDED:
        claim = f" By these, its last policy {summary.claim}." if summary.claim else ""
        return f"**Succeeded** on hardware in iteration {rows[-1]['iteration']}, after {count}.{claim}{test}"
    if summary.outcome is Outcome.NOT_SUCCEEDED:
        return f"**Did not succeed**: no policy reached the goal on hardware, after {count}.{test}"
    if summary.outcome is Outcome.WAITING:
        return f"**Waiting**, after {count}: {markdown.text(reason)}"
    if summary.outcome is Outcome.INTERRUPTED:
        return f"**Interrupted**, after {count}."
    return f"**Ended with an error**, after {count}: {markdown.code(reason)}"


def _count(rows: Sequence[Row], unfinished: int) -> str:
    """How far the trial came."""
    experiments = (rows[-1]["total_experiments"] if rows else 0) + unfinished
    text = f"{counted(len(rows), 'iteration')} and {counted(experiments, 'hardware experiment')}"
    return f"{text}, {unfinished} of them in an iteration that did not end" if unfinished else text
