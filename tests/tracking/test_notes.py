from __future__ import annotations

from types import SimpleNamespace

import pytest

from simbias.tracking import notes

STUDY = SimpleNamespace(
    title="algorithm1 on bongoboard: bias gp",
    seed=3,
    hash="abc123",
    choices={"bias": "gp", "optimizer": "cma"},
)


def row(index: int = 0, event: str = "", succeeded: bool = False) -> notes.Row:
    return notes.Row(index, 12.345678, 1.2e6, 57, 3.21, event, succeeded, 2 * (index + 1))


HOT = RuntimeError("motor\nis `hot`")


@pytest.mark.parametrize(
    ("rows", "error", "unfinished", "expected"),
    [
        ([row(0), row(1, succeeded=True)], None, 0, "**Succeeded** on hardware in iteration 1, after "),
        ([row(0)], None, 0, "**Did not succeed**: no policy reached the goal on hardware, after "),
        ([row(0)], KeyboardInterrupt(), 1, "**Interrupted**, after "),
        ([], HOT, 0, "**Ended with an error**, after "),
    ],
)
def test_verdict(rows: list[notes.Row], error: BaseException | None, unfinished: int, expected: str) -> None:
    assert notes.verdict(rows, error, unfinished).startswith(expected)


def test_verdict_counts() -> None:
    assert notes.verdict([row(0), row(1)], None, 0).endswith("2 iterations and 4 hardware experiments.")
    assert notes.verdict([row(0)], KeyboardInterrupt(), 1).endswith(
        "1 iteration and 3 hardware experiments, 1 of them in an iteration that did not end."
    )
    assert notes.verdict([], KeyboardInterrupt(), 0).endswith("0 iterations and 0 hardware experiments.")


def test_verdict_names_the_error_in_one_line() -> None:
    assert notes.verdict([], HOT, 0).endswith(": `RuntimeError: motor is 'hot'` (`error.txt`)")
    assert notes.verdict([], AssertionError(), 0).endswith(": `AssertionError` (`error.txt`)")


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
    text = notes.note(STUDY, rows, notes.verdict(rows, RuntimeError("x" * 10000), 0))
    assert len(text) < 8000
    assert "| 999 |" in text
    assert "The 960 iterations before these" in text


def test_run_name() -> None:
    assert notes.run_name(STUDY) == "gp cma seed 3"
