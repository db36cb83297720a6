"""Tables of sweeps, from trials that are made up."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pandas as pd
import pytest

from simbias.core import markdown
from simbias.sweep import results
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.tables import cells, interval, layout, legend


def made_up(sweep: Sweep, outcome: str = "succeeded") -> pd.DataFrame:
    rows = [
        {
            **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
            "hash": trial.hash, "repetition": trial.repetition, "seed": trial.seed, "outcome": outcome,
            "experiments": 2.0 * (1 + index % 3), "iterations": 1.0 + index % 3, "seconds": 1.0,
            "raised": "", **results.LATER,
        }
        for index, trial in enumerate(sweep.trials)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_a_failure_counts_all_experiments_and_an_error_none() -> None:
    sweep = expand(["+sweep=smoke", "sweep.trials=3"])
    frame = made_up(sweep)
    frame.loc[0, ["outcome", "experiments"]] = ["not succeeded", 20.0]
    frame.loc[1, ["outcome", "experiments"]] = ["error", np.nan]
    first, second = cells(frame, sweep).to_dict("records")
    own = [20.0, 2.0 * 3, 2.0 * 2]
    assert (first["trials"], first["succeeded"], first["raised"]) == (3, 2, 0)
    assert first["mean"] == pytest.approx(np.mean(own))
    assert first["low"] <= first["mean"] <= first["high"]
    assert (second["trials"], second["succeeded"], second["raised"]) == (2, 2, 1)
    text = markdown.table(*layout(cells(frame, sweep), sweep))
    assert "| 2/3 [21%, 94%] |" in text
    assert "| 2/2 [34%, 100%], 1 raised |" in text


def test_measures_are_those_that_the_report_names() -> None:
    sweep = expand(["+sweep=smoke", "sweep.trials=3", "+sweep.report.measures=[iterations,succeeded]"])
    laid = layout(cells(made_up(sweep), sweep), sweep)
    assert [head.rpartition(": ")[2] for head in laid.head[-2:]] == ["iterations", "succeeded"]
    assert [line[-2:] for line in laid.body] == [["2.0", "3/3 [44%, 100%]"]] * 2
    assert "iterations: likewise" in legend(sweep, results.in_order({}, sweep))


def test_a_number_at_the_head_of_columns_says_of_what() -> None:
    def head(columns: str) -> list[str]:
        sweep = expand(["+sweep=learners", "sweep.trials=1", f"sweep.report.columns={columns}"])
        return layout(cells(made_up(sweep), sweep), sweep).head

    assert {"inertia error 0: experiments", "inertia error 0.2: experiments"} <= set(
        head("hardware.inertia_error")
    )
    assert {"gp: experiments", "sparse_gp: experiments"} <= set(head("bias"))


def test_interval_covers_the_mean_in_most_samples() -> None:
    """And does not depend on the order of the values."""
    rng = np.random.default_rng(0)
    samples = [rng.exponential(5.0, 30) for _ in range(200)]
    covered = np.mean([low <= 5.0 <= high for low, high in map(interval, samples)])
    assert 0.87 <= covered <= 0.98
    assert interval([1.0, 2.0, 5.0]) == interval([5.0, 1.0, 2.0])
    assert np.isnan(interval([3.0])).all()
    assert interval([4.0, 4.0]) == (4.0, 4.0)


def test_the_interval_of_a_large_cell_takes_no_more_memory() -> None:
    """All its draws at once would take 160 MB."""
    tracemalloc.start()
    try:
        interval(np.arange(2000.0))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 40e6
