"""Every shipped sweep runs, and what is published is that of the sweep."""

import itertools
import runpy
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cells_compared
import goal_errors
import identify_coverage
import last_policies
import numpy as np
import optimizers
import pandas as pd
import pytest
from conftest import ROOT
from errors import one_line
from matplotlib.collections import PathCollection
from paired import paired
from published import HEAD, held
from shipped import shortened
from side_by_side import side_by_side
from sweeping import sweep_folder, table

from simbias.config import ConfigError, Variations, compose, sweeps
from simbias.config.build import build
from simbias.core import markdown
from simbias.engine.sequential import Sequential
from simbias.search.optimizer import ilqr
from simbias.sweep import results, tables
from simbias.sweep.grid import Cell, Sweep, expand
from simbias.sweep.running import run_sweep
from simbias.sweep.state import finished
from simbias.sweep.statistics import holds
from simbias.sweep.tracking import Folders
from simbias.terminal.sweep import SweepConsole

RESULTS = ROOT / "sweeps" / "results"
README = (RESULTS / "README.md").read_text()
PAIRED = {
    "ablation": ("variant", "noise"),
    "learners": ("bias",),
    "learning": ("variant",),
    "record": ("hardware.record", "method"),
    "feet": ("variant",),
}
PUBLISHED = sorted(path.parent for path in RESULTS.glob("*/trials.csv"))
LAST_CELL = {
    "claims": "{acrobot: {preset: acrobot}}",
    "methods": "{acrobot: {preset: acrobot}}",
    "regulators_test": "{biped: {preset: biped}}",
}
BUILT: set[tuple[str, str]] = set()  # the components of cells that were built, by their groups
DRAWN: set[type] = set()  # the kinds of figures that were drawn


@cache
def swept(folder: str) -> Sweep:
    """The shipped sweep of a folder of results, NAME_test on the suite's test cells; of large ones a cell."""
    name = folder.removesuffix("_test")
    overrides = ["sweep.suite.split=test"] * (name != folder)
    if folder in LAST_CELL:
        overrides.append(f"sweep.axes.cell.points={LAST_CELL[folder]}")
    return expand([f"+sweep={name}", *overrides])


def of_overrides(overrides: Sequence[str]) -> Sweep:
    """In the place of `expand`, in studies of whole sweeps."""
    return swept(overrides[0].removeprefix("+sweep="))


def published(sweep: Sweep, folder: str) -> pd.DataFrame:
    """Its published trials, of a large sweep those of the cell."""
    trials = results.published(sweep, folder)
    return trials[trials["cell"] == sweep.cells[0].labels[0]] if folder in LAST_CELL else trials


def build_what_is_new(cell: Cell) -> None:
    """Build a cell's components if one of them was in no cell before."""
    config = cell.composition.config.items()
    own = {(key, each["_target_"]) for key, each in config if isinstance(each, dict) and "_target_" in each}
    if own - BUILT:
        build(cell.composition)
        BUILT.update(own)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled", "plain_predictions")
@pytest.mark.parametrize("name", [name for name in sweeps() if not name.startswith("fig")])
def test_every_sweep_runs_shortened(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trial of the last cell: it is read back, the table has a line a cell, new figures are drawn."""
    monkeypatch.setattr(ilqr, "ITERATIONS", 1)  # of a plan
    whole = swept(f"{name}_test" if RESULTS / f"{name}_test" in PUBLISHED else name)  # which is read below
    *others, last = whole.cells
    for cell in others:
        build_what_is_new(cell)
    last = replace(last, composition=shortened(last.composition))
    figures = {key: figure for key, figure in whole.figures.items() if type(figure) not in DRAWN}
    DRAWN.update(map(type, figures.values()))
    sweep = replace(whole, base=shortened(whole.base), cells=(*others, last), repetitions=1, figures=figures)
    vars(sweep)["trials"] = sweep.trials[-1:]
    trials, _ = run_sweep(sweep, Sequential(), store := Folders(pictures=False), "again", SweepConsole())
    assert list(trials["hash"]) == [sweep.trials[0].hash]
    assert list(trials["raised"]) == [""]
    pd.testing.assert_frame_equal(finished(sweep, store), trials)
    out = capsys.readouterr().out
    assert f"{len(sweep.cells)} cells x 1 trials = 1" in out
    assert "[1/1]" in out
    assert len(table(folder).splitlines()) == 1 + len(sweep.cells)
    assert {file.stem for file in sweep_folder(folder).glob("figures/*")} == figures.keys()


@pytest.mark.slow
def test_the_published_table_is_that_of_the_published_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("paired.expand", of_overrides)
    for folder in PUBLISHED:
        sweep = swept(folder.name)
        trials = published(sweep, folder.name)
        assert len(trials) == len(sweep.trials), folder.name
        made = markdown.table(*tables.layout(tables.cells(trials, sweep), sweep))
        text = (folder / "table.md").read_text()
        assert made == text or (folder.name in LAST_CELL and text.endswith(made.split("\n", 2)[2]))
        if axes := PAIRED.get(folder.name):
            for name in (folder.name, str(folder / "trials.csv")):
                assert (folder / "paired.md").read_text() == paired(name, *axes), folder.name


@pytest.mark.slow
def test_published_trials_are_those_that_the_sweep_would_run() -> None:
    """An option that is added with its old behaviour as the default changes no seed."""
    for folder in PUBLISHED:
        sweep = swept(folder.name)
        trials = published(sweep, folder.name)
        planned = [(trial.hash, trial.repetition, trial.seed) for trial in sweep.trials]
        assert list(zip(trials["hash"], trials["repetition"], trials["seed"], strict=True)) == planned


def test_cells_count_once_and_what_raised_is_left_out(tmp_path: Path) -> None:
    """Worked out by hand: A is better in a cell of three, the others are equal."""
    rows = [
        *(("one", "A", 6 * "1" + "00"), ("one", "A", 8 * "1"), ("one", "B", 8 * "0"), ("one", "B", 8 * "0")),
        *(("two", "A", 16 * "1"), ("two", "A", 16 * "1"), ("two", "B", 16 * "1"), ("two", "B", "")),
        *(("three", "A", 16 * "1"), ("three", "B", 16 * "1")),
    ]
    trials = pd.DataFrame(rows, columns=["cell", "method", "test_episodes"])
    trials = trials.assign(lasting_episodes="", outcome="succeeded", experiments=2.0)
    trials.loc[trials["test_episodes"] == "", ["outcome", "experiments"]] = ["error", np.nan]
    trials.to_csv(tmp_path / "trials.csv", index=False)
    raised = cells_compared.read(tmp_path / "trials.csv")
    read = raised[raised["outcome"] != "error"]
    assert cells_compared.scores(read).to_numpy().tolist() == [[0.875, 0.0], [1.0, 1.0], [1.0, 1.0]]
    (row,) = cells_compared.comparisons(cells_compared.scores(read), "A", ["B"])
    assert row[:4] == ["B", "1, 0, 2", "1", "1"]
    assert row[4] == "+29.2%"  # of three cells there is no interval
    assert list(cells_compared.shortfalls(read, "A")) == []
    assert list(cells_compared.shortfalls(read, "B")) == ["one, A (88% > 19%)"]
    report = cells_compared.report(raised, "A", ["B"], "B")
    assert "| mean of 1 that B does not hold | 88% | 0% |" in report
    assert report.endswith("1 trial raised an error and is left out.")


def test_pairs_with_what_raised_are_left_out(tmp_path: Path) -> None:
    """The trial that raised is among no counts of its row either."""
    rows = [("A", 0, 5.0), ("A", 1, 4.0), ("B", 0, np.nan), ("B", 1, 2.0)]
    trials = pd.DataFrame(rows, columns=["method", "repetition", "experiments"])
    trials = trials.assign(hash="a", seed=1, iterations=trials["experiments"], seconds=1.0, raised="")
    raised = trials["experiments"].isna()
    trials["outcome"] = raised.map({True: "error", False: "succeeded"})
    trials.loc[raised, "seconds"] = 9.0
    columns = ["method", "hash", *(name for name in trials if name not in ("method", "hash"))]
    trials[columns].to_csv(tmp_path / "trials.csv", index=False)
    last, *missing = paired(str(tmp_path / "trials.csv"), "method").splitlines()[-3:]
    assert last == "| B | 2.00 | -2.00, nan | 1 of 1 | 2.00 | 1/1 [21%, 100%] | 1.0 |"
    assert missing == ["", "1 trial raised an error and is left out."]
    failed = trials.assign(outcome="not succeeded", experiments=[20.0, 20.0, 2.0, 2.0])[columns]
    failed.to_csv(tmp_path / "failed.csv", index=False)
    assert "may make (here 2 to 20: where trials failed" in paired(str(tmp_path / "failed.csv"), "method")
    failed.assign(seed=range(4)).to_csv(tmp_path / "others.csv", index=False)
    with one_line("^trials are not paired: method is not among the sweep's common_seeds$"):
        paired(str(tmp_path / "others.csv"), "method")
    for axes in (["methot"], ["method", "methot"]):
        with one_line("^no such axis: methot; there are method$"):
            paired(str(tmp_path / "trials.csv"), *axes)


@pytest.mark.slow
def test_what_is_not_published_or_lacks_a_column_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = results.published(swept("learners"))
    assert set(trials["hardware.inertia_error"]) == {"0", "0.2"}  # as of folders, not numbers
    assert set(trials["raised"]) == {""}
    sweep = expand(["+sweep=smoke"])
    monkeypatch.setattr(results, "resource_folder", lambda _: tmp_path)
    with pytest.raises(ConfigError, match=r"^sweep: smoke has no published results$"):
        results.published(sweep)
    (tmp_path / "results" / "smoke").mkdir(parents=True)
    pd.DataFrame({"hash": ["a"], "seed": [1]}).to_csv(tmp_path / "results" / "smoke" / "trials.csv")
    with pytest.raises(ConfigError, match=r"^trials\.csv: lacks experiments, hardware\.inertia_error, "):
        results.published(sweep)


@pytest.mark.slow
def test_readme_shows_the_published_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Table II of both sweeps, the ablation, and what the policies for separate feet are worth."""
    monkeypatch.setattr("side_by_side.expand", of_overrides)
    assert side_by_side() in README
    assert (RESULTS / "ablation" / "table.md").read_text() in README
    sweep, policies = swept("feet"), pd.read_csv(RESULTS / "feet" / "policies.csv")
    trials = results.published(sweep)
    assert list(policies["repetition"]) == list(trials["repetition"])
    assert last_policies.table(sweep, trials, policies) in README
    tested = pd.read_csv(RESULTS / "last_policies" / "policies.csv", dtype={"test_episodes": str})
    assert markdown.table(HEAD, held(tested)) in README


def test_the_optimizers_table_is_that_of_its_searches() -> None:
    folder = RESULTS / "optimizers"
    searches = pd.read_csv(folder / "searches.csv")
    assert set(searches.groupby(["optimizer", "budget"]).size()) == {50}
    assert set(searches["optimizer"]) > set(optimizers.OPTIMIZERS)  # some were left out since
    assert optimizers.table(searches) == (folder / "table.md").read_text()


def test_the_table_of_coverage_is_that_of_its_robots() -> None:
    folder = RESULTS / "identify_coverage"
    robots = pd.read_csv(folder / "coverage.csv")
    assert set(robots.groupby(identify_coverage.CASE).size()) == {10}
    assert identify_coverage.table(robots) in (folder / "HOW.md").read_text()


@pytest.mark.slow
def test_the_table_of_tracking_errors_is_that_of_the_trials() -> None:
    sweep, folder = swept("following"), RESULTS / "following"
    errors = pd.read_csv(folder / "errors.csv")
    assert list(errors["repetition"]) == list(results.published(sweep)["repetition"])
    rivals = ("nothing learned", "nominal model alone")
    assert goal_errors.table(sweep, errors, rivals) == (folder / "errors.md").read_text()
    drawn = (axes.collections for axes in goal_errors.figure(sweep, errors).axes)
    dots = [each.get_offsets()[:, 0] for some in drawn for each in some if isinstance(each, PathCollection)]
    np.testing.assert_allclose(sorted(np.concatenate(dots)), sorted(1000 * errors["error"]))


@pytest.mark.slow
def test_trials_are_what_composing_their_overrides_gives() -> None:
    """Axes of options too; interpolations follow: cost.failure_weight is that of cost.max_cost."""
    sweep = swept("components")
    found = {trial.cell.labels: trial for trial in sweep.trials if trial.repetition == 0}
    assert set(found) == set(itertools.product(["gp", "none"], ["nlopt_direct", "nlopt_crs", "cma"]))
    trial = found[("none", "cma")]
    overrides = ["bias=none", "optimizer=cma", "hardware.noise.torque_variance=0.1", f"seed={trial.seed}"]
    composed = compose(overrides)
    assert (trial.composition, trial.hash) == (composed.trial, composed.hash)
    chosen: dict[str, object]
    for chosen in (
        {"bias": "none", "cost.max_cost": 100.0, "hardware.noise.torque_variance": 1e-6, "seed": 7},
        {"cost.max_cost": 100.0, "hardware.noise.torque_variance": 1e-6, "bias.length_scale": [1.0] * 7},
        {"bias": "gp", "bias.d": 2.0, "hardware.feet": "fixed"},
    ):
        assert Variations().composition(chosen) == compose(
            [f"{key}={value}" for key, value in chosen.items()]
        )


@pytest.mark.slow
def test_common_seeds_pair_the_points_of_an_axis() -> None:
    """A repetition has one seed along the axis; the point that the base has keeps the seeds it had."""
    alone = {trial.hash for trial in expand(["+sweep=learners", "sweep.common_seeds=[]"]).trials}
    sweep = swept("learners")
    met: dict[tuple[object, ...], set[int]] = {}
    for trial in sweep.trials:
        *others, bias = trial.cell.labels
        met.setdefault((*others, trial.repetition), set()).add(trial.seed)
        assert (trial.hash in alone) == (bias == "gp")
    assert len(met) == len(sweep.trials) / 2
    assert {len(seeds) for seeds in met.values()} == {1}
    assert len(set().union(*met.values())) == len(met)


@pytest.mark.slow
def test_the_suites_cells_for_development_and_for_the_test_are_others() -> None:
    """So are the starts of their tests, of which there are enough to pass the bar."""
    splits = [swept(name) for name in ("suite", "suite_test")]
    hashes = [{cell.composition.group_hash for cell in each.cells} for each in splits]
    assert not hashes[0] & hashes[1]
    assert splits[0].hash != splits[1].hash
    assert [len(each) for each in hashes] == [11, 11]
    development, test = (each.base.config["policy_test"] for each in splits)
    assert development["seed"] != test["seed"]
    assert holds("1" * test["episodes"], splits[1].report.bar)
    assert (test["long_episodes"], test["long_seconds"]) == (test["episodes"], 60)
    for cell in splits[0].cells + splits[1].cells:
        if "gaps" in (hardware := cell.composition.config["hardware"]):
            assert hardware["record"] == "measured"
            assert min(hardware["noise"].values()) > 0


@pytest.mark.slow
def test_two_sweeps_of_the_same_cells_are_compared(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("simbias.sweep.grid.expand", of_overrides)
    program = str(ROOT / "sweeps" / "studies" / "two_sweeps.py")
    monkeypatch.setattr(sys, "argv", [program, "table2", "table2_box2d"])
    runpy.run_path(program, run_name="__main__")
    text = capsys.readouterr().out
    assert "difference: -0.64 [-1.53, 0.27]" in text
    assert "cells with more, with fewer: 8, 15; sign test, p = 0.21" in text
    assert "equivalent over cells within experiments of: 2" in text
