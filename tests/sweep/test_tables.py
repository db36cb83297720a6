"""Tables of sweeps, from trials that are made up."""

import tracemalloc

import numpy as np
import pandas as pd
import pytest

from simbias.core import markdown
from simbias.sweep import results
from simbias.sweep.estimate import seconds_left
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.tables import cells, interval, layout, legend


def made_up(sweep: Sweep) -> pd.DataFrame:
    rows = [
        {
            **dict(zip((axis.name for axis in sweep.axes), trial.cell.labels, strict=True)),
            "hash": trial.hash, "repetition": trial.repetition, "seed": trial.seed, "outcome": "succeeded",
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
    assert (first["trials"], first["succeeded"], first["raised"]) == (3, 2, 0)
    assert first["mean"] == pytest.approx((20 + 6 + 4) / 3)
    assert first["low"] <= first["mean"] <= first["high"]
    assert (second["trials"], second["succeeded"], second["raised"]) == (2, 2, 1)
    text = markdown.table(*layout(cells(frame, sweep), sweep))
    assert "| 2/3 [21%, 94%] |" in text
    assert "| 2/2 [34%, 100%], 1 raised |" in text


def test_measures_are_those_that_the_report_names() -> None:
    """A number at the head of columns says of what it is."""
    columns = "+sweep.report.columns=hardware.inertia_error"
    sweep = expand(
        ["+sweep=smoke", "sweep.trials=3", "+sweep.report.measures=[iterations,succeeded]", columns]
    )
    laid = layout(cells(made_up(sweep), sweep), sweep)
    heads = [
        f"inertia error {error}: {name}" for error in ("0", "0.2") for name in ("iterations", "succeeded")
    ]
    assert (laid.head, laid.body) == (heads, [["2.0", "3/3 [44%, 100%]"] * 2])
    assert "iterations: likewise" in legend(sweep, results.in_order({}, sweep))


def test_interval_covers_the_mean_in_most_samples() -> None:
    """It does not depend on the order of the values; all draws of a large cell would take 160 MB."""
    rng = np.random.default_rng(0)
    samples = [rng.exponential(5.0, 30) for _ in range(100)]
    covered = np.mean([low <= 5.0 <= high for low, high in map(interval, samples)])
    assert 0.87 <= covered <= 0.98
    assert interval([1.0, 2.0, 5.0]) == interval([5.0, 1.0, 2.0])
    assert np.isnan(interval([3.0])).all()
    assert interval([4.0, 4.0]) == (4.0, 4.0)
    tracemalloc.start()
    try:
        interval(np.arange(2000.0))
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


def test_finished_trials_tell_how_long_the_others_take() -> None:
    """Those of the same cell where there are any, else all of them; without any, nobody knows."""
    sweep = expand(["+sweep=smoke", "tracking=none"])
    first, *others = sweep.trials
    rows = [{"hash": first.hash, sweep.axes[0].name: first.cell.labels[0], "seconds": 4.0}]
    assert seconds_left(sweep, pd.DataFrame(rows), 2) == 4.0 * len(others) / 2
    assert seconds_left(sweep, pd.DataFrame({"hash": []}), 2) is None
