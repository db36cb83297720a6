from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from simbias.core.records import Iteration, Learning, Rollout, Selection
from simbias.mlflow import notes
from simbias.trial.run import Outcome, TrialRecord
from simbias.trial.study import Study

STUDY: Any = SimpleNamespace(
    title="algorithm1 on bongoboard: bias gp",
    seed=3,
    hash="abc123",
    choices={"bias": "gp", "optimizer": "cma"},
)


def row(index: int = 0, event: str = "", succeeded: bool = False) -> notes.Row:
    return notes.Row(index, 12.345678, 1.2e6, 57, 3.21, event, succeeded, 2 * (index + 1))


def ended(outcome: Outcome, unfinished: int = 0, reason: str = "") -> TrialRecord:
    return TrialRecord(outcome, (), (Rollout(np.zeros((1, 2)), np.zeros((0, 1))),) * unfinished, reason)


HOT = "RuntimeError: motor is `hot`"


@pytest.mark.parametrize(
    ("rows", "record", "expected"),
    [
        (
            [row(0), row(1, succeeded=True)],
            ended(Outcome.SUCCEEDED),
            "**Succeeded** on hardware in iteration 1, after ",
        ),
        (
            [row(0)],
            ended(Outcome.NOT_SUCCEEDED),
            "**Did not succeed**: no policy reached the goal on hardware, after ",
        ),
        ([row(0)], ended(Outcome.INTERRUPTED, 1), "**Interrupted**, after "),
        ([row(0)], ended(Outcome.WAITING, 1), "**Waiting**, after "),
        ([], ended(Outcome.ERROR, reason=HOT), "**Ended with an error**, after "),
    ],
)
def test_verdict(rows: list[notes.Row], record: TrialRecord, expected: str) -> None:
    assert notes.verdict(rows, record).startswith(expected)


def test_verdict_counts() -> None:
    assert notes.verdict([row(0), row(1)], ended(Outcome.NOT_SUCCEEDED)).endswith(
        "2 iterations and 4 hardware experiments."
    )
    assert notes.verdict([row(0)], ended(Outcome.INTERRUPTED, 1)).endswith(
        "1 iteration and 3 hardware experiments, 1 of them in an iteration that did not end."
    )
    assert notes.verdict([], ended(Outcome.INTERRUPTED)).endswith("0 iterations and 0 hardware experiments.")


def test_verdict_names_the_error_in_one_line() -> None:
    hot, bare = ended(Outcome.ERROR, reason=HOT), ended(Outcome.ERROR, reason="AssertionError")
    assert notes.verdict([], hot).endswith(": `RuntimeError: motor is  hot ` (`error.txt`)")
    assert notes.verdict([], bare).endswith(": `AssertionError` (`error.txt`)")


def test_verdict_says_what_is_awaited() -> None:
    waiting = ended(Outcome.WAITING, reason="run.csv is not there yet.")
    assert notes.verdict([row(0)], waiting).endswith("2 hardware experiments: run.csv is not there yet.")


@pytest.mark.parametrize("reset", [False, True])
def test_a_row_tells_failures_in_the_tasks_words(point_mass: Study, reset: bool) -> None:
    states = np.zeros((4, 2))
    fell = Rollout(states, np.zeros((3, 1)), 3, "distance", cost=10.0)
    lost = Rollout(states, np.zeros((3, 1)), 3, "lost_*sight*", cost=10.0)
    whole = Rollout(np.zeros((101, 2)), np.zeros((100, 1)), cost=0.0)
    empty = Selection(point_mass.no_data, 9, 9, {"distance": 9})
    iteration = Iteration(
        index=4,
        parameters=np.zeros(3),
        experiments=(fell, lost, fell, whole),
        hardware_cost=10.0,
        succeeded=False,
        total_experiments=9,
        learning=Learning(empty, point_mass.no_data, reset),
        seconds={"experiments": 1.0, "learning": 0.5},
    )
    words = "3 of 4 experiments failed: too far from the origin, lost &#42;sight&#42;"
    none = "no samples to learn from: all 9 were rejected: distance 9"
    assert notes.row(point_mass, iteration, []) == notes.Row(
        4, None, 10.0, 0, 1.5, f"{words}; model cleared; {none}" if reset else f"{words}; {none}", False, 9
    )
    assert "| 4 |  | 10 | 0 | 1.5 |" in notes.note(point_mass, [notes.row(point_mass, iteration, [])], "")


def test_note_has_trial_verdict_and_table() -> None:
    text = notes.note(STUDY, [row(0, "2 of 2 experiments failed: too fast")], "**Running**.")
    paragraphs = text.split("\n\n")
    assert paragraphs[0] == "**Running**."
    assert paragraphs[1] == "algorithm1 on bongoboard: bias gp. Seed 3, trial `abc123`."
    assert paragraphs[2].splitlines()[2] == (
        "| 0 | 12.35 | 1.2e+06 | 57 | 3.2 | 2 of 2 experiments failed: too fast |"
    )


def test_note_before_the_first_iteration_has_no_table() -> None:
    assert "|" not in notes.note(STUDY, [], notes.running([]))


def test_long_note_keeps_the_last_rows_within_mlflows_limit() -> None:
    rows = [row(i, "2 of 2 experiments failed: too far from the static equilibrium") for i in range(1000)]
    text = notes.note(STUDY, rows, notes.verdict(rows, ended(Outcome.ERROR, reason="x" * 10000)))
    assert len(text) < 8000
    assert "| 999 |" in text
    assert "The 960 iterations before these" in text


def test_run_name() -> None:
    assert notes.run_name(STUDY) == "gp cma seed 3"
