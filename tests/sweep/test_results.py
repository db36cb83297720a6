from __future__ import annotations

from functools import cache
from pathlib import Path

import last_policies
import optimizers
import pandas as pd
import pytest
from conftest import ROOT
from paired import paired
from side_by_side import side_by_side

from simbias.config import ConfigError
from simbias.core import markdown
from simbias.sweep import results, tables
from simbias.sweep.grid import Sweep, expand

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


@cache
def swept(name: str) -> Sweep:
    """A shipped sweep; to expand it takes seconds."""
    return expand([f"+sweep={name}"])


@pytest.mark.slow
@pytest.mark.parametrize("folder", PUBLISHED, ids=lambda folder: folder.name)
def test_the_published_table_is_that_of_the_published_trials(folder: Path) -> None:
    sweep = swept(folder.name)
    trials = results.published(sweep)
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
    trials = results.published(sweep)
    planned = [(trial.hash, trial.repetition, trial.seed) for trial in sweep.trials]
    assert list(zip(trials["hash"], trials["repetition"], trials["seed"], strict=True)) == planned


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
