"""Figures of sweeps as a person makes them: one command each, resumable."""

import shutil
import signal
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import chdir
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from errors import one_line
from PIL import Image
from sweeping import FOLDERS, finish, run, start, until_trials

import simbias
from simbias.__main__ import main

pytestmark = pytest.mark.slow

FAILING = ["task.horizon=300", "optimizer.max_evaluations=10", "method.max_iterations=2"]
FAILING += ["cost.max_cost=1e-3"]  # never reached
MIXED = ["task.horizon=1000", "optimizer.max_evaluations=50", "method.max_iterations=2", "bias=gp"]
SMALL = {
    "fig4": [*FAILING, "sweep.figures.fig4.columns=3"],
    "fig5": [*FAILING, "sweep.figures.fig5.experiments=1"],
    "fig6": [*FAILING, "bias=gp", "sweep.trials=2"],
    "fig7": [
        *(*MIXED, "sweep.trials=2"),
        *(f"sweep.figures.fig7.{each}" for each in ("x.points=3", "y.points=3", "experiments=1")),
    ],
}
TRIALS = {"fig4": 1, "fig5": 1, "fig6": 4, "fig7": 4}


def command(name: str) -> list[str]:
    """A small sweep of a figure, without MLflow and without pictures of its trials."""
    return [f"+sweep={name}", *SMALL[name], *FOLDERS, "engine=sequential"]


def made_files(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (folder / "figures").iterdir()}


def trials(folder: Path) -> list[Path]:
    return [file.parent for file in folder.glob("trials/*/outcome.json")]


def batches(folder: Path) -> dict[str, str]:
    """The outcomes that the sweep keeps of the experiments of its figure, by file."""
    return {file.name: file.read_text() for file in folder.glob("trials/sweeps/*/experiments/*")}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A folder in which a figure's sweep has run, by the figure's name."""

    @cache
    def make(name: str) -> Path:
        folder = tmp_path_factory.mktemp(name)
        with chdir(folder):
            assert main(command(name)) == 0
        return folder

    return make


@pytest.mark.parametrize("name", SMALL)
def test_files(made: Callable[[str], Path], name: str) -> None:
    """In the user's folder and in the sweep's."""
    folder = made(name)
    files = made_files(folder)
    suffixes = [".png", ".svg", ".pdf", ".csv", ".md", *([".gif"] if name == "fig4" else [])]
    assert set(files) == {f"{name}{suffix}" for suffix in suffixes}
    assert len(np.unique(np.asarray(Image.open(folder / "figures" / f"{name}.png").convert("L")))) > 20
    assert ET.fromstring(files[f"{name}.svg"]).tag.endswith("svg")
    assert len(pd.read_csv(folder / "figures" / f"{name}.csv")) >= 4
    (kept,) = folder.glob("trials/sweeps/*/figures")
    assert {file.name: file.read_bytes() for file in kept.iterdir()} == files
    assert len(trials(folder)) == TRIALS[name]


def test_the_same_trials_give_the_same_files(
    made: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = made("fig4")
    files = made_files(folder)
    shutil.rmtree(folder / "figures")
    capsys.readouterr()
    with chdir(folder):
        assert main(command("fig4")) == 0
    assert made_files(folder) == files
    out = capsys.readouterr().out
    assert "figures/fig4.png" in out
    assert f"fig4: {' '.join(files['fig4.md'].decode().split())}" in out


def test_costs_are_those_of_the_trials(made: Callable[[str], Path]) -> None:
    folder = made("fig6")
    numbers = pd.read_csv(folder / "figures" / "fig6.csv")
    assert len(trials(folder)) == numbers.groupby(["cell", "seed"]).ngroups == 4
    for path in trials(folder):
        trial = simbias.load_trial(path)
        own = numbers[numbers["seed"] == trial.study.seed]
        expected = [iteration.hardware_cost for iteration in trial.iterations]
        assert list(own["hardware_cost"]) == pytest.approx(expected, rel=1e-5)


def test_success_rates_are_those_of_experiments_from_the_grid(
    made: Callable[[str], Path], tmp_path: Path
) -> None:
    """Repeated one by one; another grid runs its own experiments, the trials do not."""
    folder = Path(shutil.copytree(made("fig7"), tmp_path / "copy"))
    numbers, once = pd.read_csv(folder / "figures" / "fig7.csv"), batches(folder)
    assert 2 <= len(once) <= 4  # two policies of each of two cells, once each, if they differ
    assert 0 < numbers["succeeded"].sum() < numbers["experiments"].sum()
    found = pd.read_csv(next(folder.glob("trials/sweeps/*/trials.csv")), dtype={"hash": str})
    noise = {"torque": 0.1, "angle": 1.6e-5, "velocity": 1.6e-2}
    study = simbias.load(
        [*MIXED, *(f"hardware.noise.{key}_variance={value}" for key, value in noise.items())]
    )
    for trial in found.to_dict("records"):
        policy = simbias.load_trial(folder / "trials" / trial["hash"]).iterations[-1].parameters
        same = (numbers["cell"] == trial["noise"]) & (numbers["repetition"] == trial["repetition"])
        rngs = np.random.default_rng(trial["repetition"]).spawn(same.sum())
        for row, rng in zip(numbers[same].to_dict("records"), rngs, strict=True):
            x = np.array([row["alpha_w"], row["alpha_b"], *study.task.start_mean[2:]])
            assert study.cost.passes(study.experiment(policy, rng, x)) == row["succeeded"]
    with chdir(folder):
        assert main([*command("fig7"), "sweep.figures.fig7.y.points=2"]) == 0
    assert len(batches(folder)) == 2 * len(once)
    assert once.items() < batches(folder).items()
    assert len(trials(folder)) == 4


def test_killed_among_a_figures_experiments(made: Callable[[str], Path], tmp_path: Path) -> None:
    """Nothing that is kept runs again, what was half written does; jobs change nothing."""
    shutil.copytree(made("fig7"), tmp_path, dirs_exist_ok=True)
    uninterrupted, figures = batches(tmp_path), made_files(tmp_path)
    total = len(uninterrupted)
    for folder in (tmp_path / "figures", *tmp_path.glob("trials/sweeps/*/experiments")):
        shutil.rmtree(folder)
    process = start(*command("fig7"), folder=tmp_path)
    until_trials(process, 1)  # batch
    process.send_signal(signal.SIGKILL)
    finish(process)
    before = batches(tmp_path)
    assert 1 <= len(before) < total
    first, *others = sorted(before)
    (folder,) = tmp_path.glob("trials/sweeps/*/experiments")
    (folder / first).write_text(before[first][:-9])
    status, out, err = run(*command("fig7"), "engine=loky", "engine.n_jobs=2", folder=tmp_path)
    assert (status, err) == (0, "")
    assert f"[{len(others) + 1}/{total}]" in out
    assert f"[{len(others)}/{total}]" not in out
    assert batches(tmp_path) == uninterrupted
    assert made_files(tmp_path) == figures


def test_figure_without_a_store(folder: Path) -> None:
    """One that needs no trial in full is drawn from the table."""
    quick = ["task.horizon=200", "optimizer.max_evaluations=20", "engine=sequential", "sweep.trials=1"]
    assert main(["+sweep=smoke", *quick, "tracking=none", "+sweep.figures_to=here"]) == 0
    assert {file.name for file in (folder / "here").iterdir()} == {
        f"experiments.{suffix}" for suffix in ("png", "svg", "pdf", "csv", "md")
    }
    file = folder / "here" / "experiments.csv"
    for place in (file, file / "below"):
        with one_line(f"^sweep.figures_to: {file} is not a folder"):
            simbias.run_sweep(["+sweep=smoke", *quick, "tracking=none", f"+sweep.figures_to={place}"])
