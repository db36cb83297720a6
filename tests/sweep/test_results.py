"""Every shipped sweep runs, and what is published is that of the sweep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import cells_compared
import goal_errors
import last_policies
import optimizers
import pandas as pd
import pytest
from conftest import ROOT
from in_numpy import predict_in_numpy
from paired import paired
from published import held
from shipped import shortened
from side_by_side import side_by_side
from sweeping import sweep_folder, table

from simbias.config import ConfigError, sweeps
from simbias.core import markdown
from simbias.engine.sequential import Sequential
from simbias.search.optimizer import ilqr
from simbias.sweep import results, tables
from simbias.sweep.grid import Cell, Sweep, expand
from simbias.sweep.running import run_sweep
from simbias.sweep.state import finished
from simbias.sweep.tracking import Folders
from simbias.terminal.sweep import SweepConsole

RESULTS = ROOT / "sweeps" / "results"
README = RESULTS / "README.md"
PAIRED = {
    "ablation": ("variant", "noise"),
    "learners": ("bias",),
    "learning": ("variant",),
    "record": ("hardware.record", "method"),
    "feet": ("variant",),
}
PUBLISHED = sorted(path.parent for path in RESULTS.glob("*/trials.csv"))
ON_TEST_CELLS = {folder.name.removesuffix("_test") for folder in PUBLISHED if folder.name.endswith("_test")}
RUN: set[tuple[str, str]] = set()  # the components of cells that ran, by their groups


@cache
def swept(folder: str) -> Sweep:
    """The shipped sweep of a folder of results; NAME_test is on the suite's test cells. It takes seconds."""
    name = folder.removesuffix("_test")
    return expand([f"+sweep={name}", *["sweep.suite.split=test"] * (name != folder)])


def few(sweep: Sweep) -> Iterator[Cell]:
    """The last cell, and before it those that bring a component that no sweep has run yet, or the first."""
    *cells, last = sweep.cells
    brings(last)
    yield from [cell for cell in cells if brings(cell)] or cells[:1]
    yield last


def brings(cell: Cell) -> bool:
    """Whether a component of a cell has not been run yet; now it is."""
    config = cell.composition.config.items()
    own = {(key, each["_target_"]) for key, each in config if isinstance(each, dict) and "_target_" in each}
    new = own - RUN
    RUN.update(new)
    return bool(new)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in sweeps() if not name.startswith("fig")])
def test_every_sweep_runs_shortened(
    name: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    uncompiled: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A few trials; they are read back, the table has a line for each cell, and the figures are drawn."""
    monkeypatch.setattr(ilqr, "ITERATIONS", 1)  # of a plan
    predict_in_numpy(monkeypatch)
    whole = swept(f"{name}_test" if name in ON_TEST_CELLS else name)  # which is listed below, too
    run = {cell.labels: replace(cell, composition=shortened(cell.composition)) for cell in few(whole)}
    cells = tuple(run.get(cell.labels, cell) for cell in whole.cells)
    sweep = replace(whole, base=shortened(whole.base), cells=cells, repetitions=1)
    vars(sweep)["trials"] = tuple(trial for trial in sweep.trials if trial.cell.labels in run)
    trials, _ = run_sweep(sweep, Sequential(), store := Folders(pictures=False), "again", SweepConsole())
    assert list(trials["hash"]) == [trial.hash for trial in sweep.trials]
    assert set(trials["raised"]) == {""}
    pd.testing.assert_frame_equal(finished(sweep, store), trials)
    out = capsys.readouterr().out
    assert f"{len(cells)} cells x 1 trials = {len(run)}" in out
    assert f"[{len(run)}/{len(run)}]" in out
    assert len(table(folder).splitlines()) == 1 + len(cells)
    assert {file.stem for file in sweep_folder(folder).glob("figures/*")} == set(sweep.figures)


@pytest.mark.slow
@pytest.mark.parametrize("folder", PUBLISHED, ids=lambda folder: folder.name)
def test_the_published_table_is_that_of_the_published_trials(folder: Path) -> None:
    sweep = swept(folder.name)
    trials = results.published(sweep, folder.name)
    assert len(trials) == len(sweep.trials)
    table = tables.layout(tables.cells(trials, sweep), sweep)
    assert markdown.table(*table) == (folder / "table.md").read_text()
    if axes := PAIRED.get(folder.name):
        assert (folder / "paired.md").read_text() == paired(folder.name, *axes)


@pytest.mark.slow
@pytest.mark.parametrize("folder", PUBLISHED, ids=lambda folder: folder.name)
def test_published_trials_are_those_that_the_sweep_would_run(folder: Path) -> None:
    """An option that is added with its old behaviour as the default changes no seed."""
    sweep = swept(folder.name)
    trials = results.published(sweep, folder.name)
    planned = [(trial.hash, trial.repetition, trial.seed) for trial in sweep.trials]
    assert list(zip(trials["hash"], trials["repetition"], trials["seed"], strict=True)) == planned


@pytest.mark.slow
def test_methods_of_a_cell_meet_the_same_starts() -> None:
    sweep = swept("methods")
    seeds = {(trial.cell.labels[0], trial.repetition): trial.seed for trial in sweep.trials}
    assert all(trial.seed == seeds[trial.cell.labels[0], trial.repetition] for trial in sweep.trials)
    assert len(set(seeds.values())) == len(seeds) == len(sweep.trials) / 23
    assert len(sweep.cells) == len({cell.composition.group_hash for cell in sweep.cells}) == 11 * 23


def test_cells_count_once_and_what_raised_counts_as_nothing(tmp_path: Path) -> None:
    """Worked out by hand: A is better in two cells of three, the third is equal."""
    rows = [
        *(("one", "A", 6 * "1" + "00"), ("one", "A", 8 * "1"), ("one", "B", 8 * "0"), ("one", "B", 8 * "0")),
        *(("two", "A", 16 * "1"), ("two", "A", 16 * "1"), ("two", "B", 16 * "1"), ("two", "B", "")),
        *(("three", "A", 16 * "1"), ("three", "B", 16 * "1")),
    ]
    trials = pd.DataFrame(rows, columns=["cell", "method", "test_episodes"])
    trials.assign(lasting_episodes="", experiments=2.0).to_csv(tmp_path / "trials.csv", index=False)
    read = cells_compared.read(tmp_path / "trials.csv")
    assert cells_compared.scores(read).to_numpy().tolist() == [[0.875, 0.0], [1.0, 0.5], [1.0, 1.0]]
    (row,) = cells_compared.comparisons(cells_compared.scores(read), "A", ["B"])
    assert row[:4] == ["B", "2, 0, 1", "0.5", "0.5"]
    assert row[4].startswith("+45.8% [")
    assert list(cells_compared.shortfalls(read, "A")) == []
    assert list(cells_compared.shortfalls(read, "B")) == ["one, A (88% > 19%)"]
    assert "| mean of 2 that B does not hold | 94% | 25% |" in cells_compared.report(read, "A", ["B"], "B")


def test_what_last_policies_hold_is_counted() -> None:
    """Of three: all starts and both minutes, nine in ten but no minute, half of them."""
    rows = {"test_episodes": ["1" * 20, "1" * 18 + "00", "10" * 10], "long_success_rate": [1.0, 0.5, 1.0]}
    (row,) = held(pd.DataFrame({"sweep": "mine", **rows}))
    assert row == ["mine", "3", "80% [50%, 100%]", "2 of 3 (21% to 94%)", "2 of 3 (21% to 94%)"]


@pytest.mark.slow
def test_published_trials_are_typed_as_those_of_folders() -> None:
    trials = results.published(swept("learners"))
    axes = ["hardware.noise.torque_variance", "hardware.inertia_error", "bias"]
    assert list(trials.columns) == [*axes, *results.COLUMNS]
    assert set(trials["hardware.inertia_error"]) == {"0", "0.2"}
    assert trials["experiments"].dtype == float
    assert set(trials["raised"]) == {""}


def test_what_is_not_published_or_lacks_a_column_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = expand(["+sweep=smoke"])
    monkeypatch.setattr(results, "resource_folder", lambda _: tmp_path)
    with pytest.raises(ConfigError, match=r"^sweep: smoke has no published results$"):
        results.published(sweep)
    (tmp_path / "results" / "smoke").mkdir(parents=True)
    pd.DataFrame({"hash": ["a"], "seed": [1]}).to_csv(tmp_path / "results" / "smoke" / "trials.csv")
    with pytest.raises(ConfigError, match=r"^trials\.csv: lacks experiments, hardware\.inertia_error, "):
        results.published(sweep)


@pytest.mark.slow
def test_readmes_table_is_that_of_both_published_sweeps() -> None:
    assert side_by_side() in README.read_text()


def test_the_optimizers_table_is_that_of_its_searches() -> None:
    folder = RESULTS / "optimizers"
    searches = pd.read_csv(folder / "searches.csv")
    assert set(searches.groupby(["optimizer", "budget"]).size()) == {50}
    assert set(searches["optimizer"]) > set(optimizers.OPTIMIZERS)  # some were left out since
    assert optimizers.table(searches) == (folder / "table.md").read_text()


def test_readme_shows_the_published_table_of_the_ablation() -> None:
    table = RESULTS / "ablation" / "table.md"
    assert table.read_text() in README.read_text()


@pytest.mark.slow
def test_readme_shows_what_the_policies_for_separate_feet_are_worth() -> None:
    sweep = swept("feet")
    policies = pd.read_csv(RESULTS / "feet" / "policies.csv")
    trials = results.published(sweep)
    assert list(policies["repetition"]) == list(trials["repetition"])
    assert last_policies.table(sweep, trials, policies) in README.read_text()


@pytest.mark.slow
def test_the_table_of_tracking_errors_is_that_of_the_trials() -> None:
    sweep, folder = swept("following"), RESULTS / "following"
    errors = pd.read_csv(folder / "errors.csv")
    assert list(errors["repetition"]) == list(results.published(sweep)["repetition"])
    rivals = ("nothing learned", "nominal model alone")
    assert goal_errors.table(sweep, errors, rivals) == (folder / "errors.md").read_text()
