"""The notes of runs in Markdown: setup, results, outcome."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

from simbias.core import markdown
from simbias.core.messages import counted
from simbias.trial.folder import Withdrawal
from simbias.trial.summary import COLUMNS, IDENTIFIED, PARAMETERS, Outcome, TrialSummary, cells, parameters

NOTE_LENGTH = 8000  # maximum characters of a note in MLflow
SHOWN_ROWS = 40  # rows that fit into it
MORE = "\n\n{} more rows are in `table.md` once the sweep has ended."
REASON_LENGTH = 500
ARTIFACTS = "Artifacts: `config.yaml`, `trial/` (searches, experiments, iterations), `pictures/` if drawn."
Row = Mapping[str, Any]  # of an iteration: `simbias.trial.summary.iteration_summary`


def run_name(description: Mapping[str, Any]) -> str:
    """The name of a trial's run."""
    choices = description["choices"]
    setup = f"{choices['task']} {choices['method']}, bias {choices['bias']}, {choices['optimizer']}"
    return f"{setup}, seed {description['seed']}"


def note(
    description: Mapping[str, Any],
    rows: Sequence[Row],
    summary: TrialSummary | None,
    running: bool,
    withdrawals: Sequence[Withdrawal] = (),
    origin: Sequence[str] = (),
) -> str:
    """The verdict, the trial and its origin, withdrawals, and rows of the last `SHOWN_ROWS` iterations."""
    parts = [
        _under_way(rows, running) if summary is None else _verdict(summary),
        f"{markdown.text(description['title'])}. Seed {description['seed']}, trial `{description['hash']}`.",
    ]
    parts += origin
    parts += [f"**Withdrawn**: {markdown.text(str(each))}." for each in withdrawals]
    if rows:
        parts.append(markdown.table(COLUMNS, map(cells, rows[-SHOWN_ROWS:])).rstrip())
    if len(rows) > SHOWN_ROWS:
        parts.append(f"The {len(rows) - SHOWN_ROWS} earlier iterations are among the metrics.")
    if identified := parameters(rows):
        parts.append("Identified parameters of the last policy's model:")
        parts += [markdown.table(PARAMETERS, identified).rstrip(), IDENTIFIED]
    return "\n\n".join([*parts, ARTIFACTS])


def with_table(text: str, table: str) -> str:
    """A text followed by a table, truncated to MLflow's limit."""
    rows = table.splitlines()
    room = NOTE_LENGTH - len(f"\n\n{MORE.format(len(rows))}")
    text = text[:room]
    shown = sum(end <= room - len(text) for end in accumulate(len(row) + 1 for row in rows))
    more = MORE.format(len(rows) - shown) if shown < len(rows) else ""
    return "\n\n".join([text, "\n".join(rows[:shown])]) + more


def _verdict(summary: TrialSummary) -> str:
    """How a trial ended or stopped."""
    reason = summary.reason[:REASON_LENGTH]
    code = summary.outcome is Outcome.ERROR
    why = f" {markdown.code(reason) if code else markdown.text(reason)}" if reason else ""
    verdict = f"**{summary.outcome.verdict}** after {summary.effort}.{why}"
    return " ".join([verdict, *summary.findings])


def _under_way(rows: Sequence[Row], running: bool) -> str:
    """The progress of a trial that is running, or was killed."""
    experiments = counted(rows[-1]["total_experiments"] if rows else 0, "hardware experiment")
    return f"**{'Running' if running else 'Killed'}** after {counted(len(rows), 'iteration')}, {experiments}."
