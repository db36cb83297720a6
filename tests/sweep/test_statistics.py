"""Statistics and tables of sweeps, against published examples, other libraries and simulation."""

import runpy
import tracemalloc
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from scipy.stats import mannwhitneyu

from simbias.core import markdown
from simbias.sweep import results
from simbias.sweep.grid import Sweep, expand
from simbias.sweep.statistics import (
    bootstrap,
    episodes_needed,
    holds,
    holm,
    interquartile_mean,
    mean_text,
    passed,
    performance_profile,
    probability_of_improvement,
    sign_test,
)
from simbias.sweep.tables import BLANK, cells, interval, layout, legend
from simbias.terminal.sweep import seconds_left


@pytest.fixture(scope="module")
def smoke() -> Sweep:
    """Two cells of three trials."""
    return expand(["+sweep=smoke", "sweep.trials=3"])


def test_sixteen_of_sixteen_hold_and_fifteen_do_not(smoke: Sweep) -> None:
    """A table tells of no policy with fewer episodes whether it holds."""
    assert all(holds(text) for text in ("1" * 16, "1" * 25 + "0"))
    assert not any(holds(text) for text in ("1" * 15, "1" * 15 + "0", ""))
    assert episodes_needed() == 16
    assert [holds("1" * (episodes_needed(bar) - less), bar) for bar in (0.1, 0.95) for less in (0, 1)] == [
        *(True, False),
        *(True, False),
    ]
    sweep = replace(smoke, report=replace(smoke.report, measures=("holds",)))
    frame = made_up(sweep).assign(test_episodes="1" * 10)
    assert [row[-1] for row in layout(cells(frame, sweep), sweep).body] == ["–"] * 2  # noqa: RUF001
    assert "(of those with the 16 episodes it takes)" in legend(sweep, frame)
    frame.loc[0, "test_episodes"] = "1" * 16
    assert [row[-1] for row in layout(cells(frame, sweep), sweep).body] == ["1/1 [21%, 100%]", "–"]  # noqa: RUF001
    for policy, interval_ in (("", "[44%, 100%]"), ("that of all", "[21%, 100%]")):  # equal ones count once
        frame = made_up(sweep).assign(test_episodes="1" * 16, policy=policy)
        assert [row[-1] for row in layout(cells(frame, sweep), sweep).body] == [f"3/3 {interval_}"] * 2


@pytest.mark.slow
def test_an_episode_that_lasts_and_misses_its_goal_is_not_passed(smoke: Sweep) -> None:
    """Nor one that succeeds and fails later; without success of the task's own, what lasts succeeds."""
    assert passed("1100", "1010") == "1000"
    assert passed("1100", "") == "1100"
    frame = made_up(smoke).assign(test_episodes="0" * 16, lasting_episodes="1" * 16)
    assert cells(frame, smoke)["holding"].tolist() == [0, 0]


def test_scores_of_cells() -> None:
    """The interquartile mean leaves out a quarter on each side, a profile falls from all to none."""
    scores = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0], [6.0, 700.0]])
    assert interquartile_mean(scores) == np.mean([2.0, 3.0, 4.0, 5.0])
    profile = performance_profile(np.array([[0.2, 0.4], [0.6, 0.8]]), np.array([0.0, 0.4, 0.9]))
    assert profile.tolist() == [1.0, 0.5, 0.0]


def test_runs_that_raised_are_in_no_statistic() -> None:
    """Neither in those of all scores nor in resamples."""
    raised = np.array([[np.nan, 1.0], [0.5, 1.0], [0.5, np.nan]])
    assert interquartile_mean(raised) == 0.75
    assert performance_profile(raised, np.array([0.0, 0.6])).tolist() == [1.0, 0.5]
    assert probability_of_improvement(raised, np.array([[0.5, 0.0]] * 3)) == 0.75
    assert bootstrap(interquartile_mean, np.tile(raised, 3)) == (0.5, 1.0)


def test_probability_of_improvement_is_mann_whitneys() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 4, (7, 1)), rng.integers(0, 4, (5, 1))
    expected = mannwhitneyu(ours[:, 0], theirs[:, 0]).statistic / 35
    assert probability_of_improvement(ours, theirs) == pytest.approx(expected)
    assert probability_of_improvement(np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])) == 0.5  # cell by cell


@pytest.mark.slow
def test_bootstrap_covers_the_mean_of_other_cells() -> None:
    """Also where a cell's runs are all alike; of few cells, or the same difference in each, there is none."""
    rng = np.random.default_rng(1)
    found = [bootstrap(np.mean, np.tile(rng.normal(1.0, 1.0, 20), (3, 1))) for _ in range(20)]
    assert 0.8 <= np.mean([low <= 1.0 <= high for low, high in found]) <= 0.99
    cells = np.array([[0.0, 1.0] * 4] * 3)
    low, high = bootstrap(np.mean, cells)
    assert low < 0.25 < 0.75 < high
    assert np.isnan(bootstrap(lambda a, b: float(np.mean(a - b)), cells + 0.25, cells)).all()
    assert np.isnan(bootstrap(np.mean, cells[:, :4])).all()


def test_sign_test_is_mcnemars() -> None:
    """Of 236 pairs that differ, 86 differ one way (A. Agresti, Categorical Data Analysis, Section 10.1)."""
    assert sign_test([1.0] * 86 + [-1.0] * 150 + [0.0] * 1000) == pytest.approx(3.7e-5, rel=0.05)
    assert sign_test([1.0] * 5) == pytest.approx(2 * 0.5**5)
    assert sign_test([0.0, 0.0]) == 1.0


def test_holm_is_the_textbooks() -> None:
    assert holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": 0.005}) == pytest.approx(
        {"a": 0.03, "b": 0.06, "c": 0.06, "d": 0.02}
    )
    assert holm({"a": 0.9, "b": 0.8}) == {"a": 1.0, "b": 1.0}


def test_no_difference_is_said_only_within_the_margin() -> None:
    program = str(ROOT / "sweeps" / "studies" / "two_sweeps.py")
    equivalent = runpy.run_path(program)["equivalent"]
    near = np.random.default_rng(2).normal(0.0, 0.1, 30)
    assert equivalent(near.tolist(), 0.1)
    assert not equivalent(near.tolist(), 0.02)  # too few pairs to tell
    assert not equivalent((near + 0.2).tolist(), 0.1)
    assert not equivalent([0.0], 0.1)
    assert equivalent([0.0, 0.0, 0.0], 0.1)


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


def test_a_failure_counts_all_experiments_and_an_error_none(smoke: Sweep) -> None:
    frame = made_up(smoke)
    frame.loc[0, ["outcome", "experiments"]] = ["not succeeded", 20.0]
    frame.loc[1, ["outcome", "experiments"]] = ["error", np.nan]
    first, second = cells(frame, smoke).to_dict("records")
    assert (first["trials"], first["succeeded"], first["raised"]) == (3, 2, 0)
    assert first["mean"] == pytest.approx((20 + 6 + 4) / 3)
    assert (second["trials"], second["succeeded"], second["raised"]) == (2, 2, 1)
    text = markdown.table(*layout(cells(frame, smoke), smoke))
    assert "| 2/3 [21%, 94%] |" in text
    assert "| 2/2 [34%, 100%], 1 raised |" in text
    assert legend(smoke, frame).endswith(" 1 trial raised an error and is left out.")
    assert "counts all that it may make;" in legend(smoke, frame)
    frame.loc[3, ["outcome", "experiments"]] = ["not succeeded", 2.0]  # of another method
    assert "counts all that it may make (here 2 to 20: where trials failed, a" in legend(smoke, frame)


def test_measures_are_those_that_the_report_names() -> None:
    """A number at the head of columns says of what it is."""
    columns = "+sweep.report.columns=hardware.inertia_error"
    measures = ("iterations", "succeeded", "hardware_seconds")
    report = f"+sweep.report.measures=[{','.join(measures)}]"
    sweep = expand(["+sweep=smoke", "sweep.trials=3", report, columns])
    laid = layout(cells(made_up(sweep), sweep), sweep)
    heads = [f"inertia error {error}: {name}" for error in ("0", "0.2") for name in measures]
    assert (laid.head, laid.body) == (heads, [["2.0", "3/3 [44%, 100%]", BLANK] * 2])
    said = legend(sweep, results.in_order({}, sweep))
    assert "iterations: likewise" in said
    assert "hardware_seconds: mean duration of the experiments made, also without success" in said


@pytest.mark.slow
def test_interval_covers_the_mean_in_most_samples() -> None:
    """Also of a few counts; not by their order. All draws of a large cell would take 160 MB."""
    rng = np.random.default_rng(0)
    mean = (1.0 - 0.7**10) / 0.3  # of geometric counts, cut off at ten
    for count in (5, 10, 30):
        samples = np.minimum(rng.geometric(0.3, (400, count)), 10).astype(float)
        covered = np.mean([low <= mean <= high for low, high in map(interval, samples)])
        assert 0.85 <= covered <= 0.97, count
    assert interval([1.0, 2.0, 5.0, 3.0, 3.0]) == interval([3.0, 5.0, 1.0, 3.0, 2.0])
    assert np.isnan([interval([2.0, 4.0, 6.0, 8.0]), interval([4.0] * 10)]).all()
    assert mean_text([2.0, 4.0], ".1f") == "3.0"
    tracemalloc.start()
    try:
        interval(np.arange(2000.0))
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_finished_trials_tell_how_long_the_others_take(smoke: Sweep) -> None:
    """Those of the same cell where there are any, else all of them; without any, nobody knows."""
    first, *others = smoke.trials
    rows = [{"hash": first.hash, smoke.axes[0].name: first.cell.labels[0], "seconds": 4.0}]
    assert seconds_left(smoke, pd.DataFrame(rows), 2) == 4.0 * len(others) / 2
    assert seconds_left(smoke, pd.DataFrame({"hash": []}), 2) is None
