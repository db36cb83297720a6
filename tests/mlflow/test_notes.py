"""What a run's note says."""

from typing import Any

from simbias.mlflow import notes
from simbias.trial.summary import Outcome, TrialSummary

ABOUT = {
    "title": "algorithm1 on bongoboard: bias gp",
    "seed": 3,
    "hash": "abc123",
    "choices": {"task": "cartpole", "method": "algorithm1", "bias": "gp", "optimizer": "cma"},
}


def row(index: int, *events: str, succeeded: bool = False) -> dict[str, Any]:
    return {
        "iteration": index,
        "predicted_cost": 12.345678,
        "hardware_cost": 1.2e6,
        "samples": 57,
        "seconds": {"search": 3.0, "learning": 0.21},
        "events": events,
        "succeeded": succeeded,
        "total_experiments": 2 * (index + 1),
    }


def note(rows: list[dict[str, Any]], summary: TrialSummary | None = None, running: bool = False) -> str:
    return notes.note(ABOUT, rows, summary, running)


def test_its_first_line_is_how_the_trial_stands() -> None:
    two, hot = [row(0), row(1, succeeded=True)], "RuntimeError: motor is `hot` | <b>"
    for outcome, reason, expected in [
        (Outcome.SUCCEEDED, "", "**Succeeded** after 5 hardware experiments (2 iterations, 9 s)."),
        (Outcome.WAITING, "run.csv is missing.", "9 s). run.csv is missing."),
        (Outcome.ERROR, hot, "9 s). `RuntimeError: motor is  hot  | <b>`"),
    ]:
        summary = TrialSummary(outcome, reason, experiments=5, iterations=2, seconds=9.2)
        assert expected in note(two, summary).split("\n\n")[0]
    assert note([], running=True).startswith("**Running** after 0 iterations, 0 hardware experiments.")
    assert note(two).startswith("**Killed** after 2 iterations, 4 hardware experiments.")
    tested = TrialSummary(Outcome.SUCCEEDED, experiments=4, test_episodes="11", test_words="All went well.")
    assert note(two, tested).split("\n\n")[0].endswith("All went well.")


def test_it_has_the_trial_and_a_row_for_each_iteration() -> None:
    none = row(1) | {"predicted_cost": None}
    text = note([row(0, "2 of 2 failed: lost *sight*", "model cleared"), none])
    _, trial, table, _ = text.split("\n\n")
    assert trial == "algorithm1 on bongoboard: bias gp. Seed 3, trial `abc123`."
    assert table.splitlines()[2:] == [
        "| 0 | 12.35 | 1.2e+06 | 2 | 57 | 3.2 | 2 of 2 failed: lost &#42;sight&#42;; model cleared |",
        "| 1 |  | 1.2e+06 | 4 | 57 | 3.2 |  |",
    ]
    assert "|" not in note([])
    assert notes.run_name(ABOUT) == "cartpole algorithm1, bias gp, cma, seed 3"


def test_a_long_one_keeps_the_last_rows_within_mlflows_limit() -> None:
    rows = [row(i, "2 of 2 experiments failed: too far from the static equilibrium") for i in range(1000)]
    text = note(rows, TrialSummary(Outcome.ERROR, "x" * 10000, experiments=2000))
    assert len(text) < 8000
    assert "| 999 |" in text
    assert "The 960 earlier iterations" in text


def test_a_sweeps_table_ends_between_two_rows_within_mlflows_limit() -> None:
    table = "".join(f"| cell {i} | {'x' * 70} |\n" for i in range(1000))
    text = notes.with_table("how to resume", table)
    assert 7800 < len(text) <= 8000
    *_, last, _, more = text.splitlines()
    left = 999 - int(last.split()[2])
    assert last.endswith(" |")
    assert more == f"{left} more rows are in `table.md` once the sweep has ended."
    long = notes.with_table("x" * 8100, table)
    assert len(long) == 8000
    assert long.endswith("1000 more rows are in `table.md` once the sweep has ended.")
    assert notes.with_table("how to resume", table[:400]) == f"how to resume\n\n{table[:400]}".rstrip()
