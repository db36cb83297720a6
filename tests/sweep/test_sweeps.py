"""Figures of sweeps as a person makes them: one command each, resumable."""

from __future__ import annotations

import re
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
from PIL import Image
from sweeping import FOLDERS, finish, run, start, until_trials, write_sweep

import simbias
from simbias.__main__ import main

pytestmark = pytest.mark.slow

FAILING = ["task.horizon=1000", "optimizer.max_evaluations=20", "method.max_iterations=2"]
FAILING += ["cost.max_cost=1e-3"]  # never reached
MIXED = ["task.horizon=1500", "optimizer.max_evaluations=50", "method.max_iterations=2"]
SMALL = {
    "fig4": [*FAILING, "sweep.figures.fig4.columns=3"],
    "fig5": [*FAILING, "sweep.figures.fig5.experiments=1"],
    "fig6": [*FAILING, "sweep.trials=2"],
    "fig7": [
        *MIXED,
        "sweep.trials=2",
        "sweep.figures.fig7.x.points=3",
        "sweep.figures.fig7.y.points=5",
        "sweep.figures.fig7.experiments=1",
    ],
}
ENGINES = {"fig7": ["engine.n_jobs=2"]}
TRIALS = {"fig4": 1, "fig5": 1, "fig6": 4, "fig7": 4}


def command(name: str) -> list[str]:
    """A small sweep of a figure, without MLflow and without pictures of its trials."""
    return [f"+sweep={name}", *SMALL[name], *FOLDERS]


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
            assert main([*command(name), *ENGINES.get(name, ["engine=sequential"])]) == 0
        return folder

    return make


@pytest.mark.parametrize("name", SMALL)
def test_files(made: Callable[[str], Path], name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """In the user's folder and in the sweep's; the same trials give the same files."""
    folder = made(name)
    files = made_files(folder)
    suffixes = [".png", ".svg", ".csv", ".md", *([".gif"] if name == "fig4" else [])]
    assert set(files) == {f"{name}{suffix}" for suffix in suffixes}
    assert len(np.unique(np.asarray(Image.open(folder / "figures" / f"{name}.png").convert("L")))) > 20
    assert ET.fromstring(files[f"{name}.svg"]).tag.endswith("svg")
    assert len(pd.read_csv(folder / "figures" / f"{name}.csv")) >= 4
    (kept,) = folder.glob("trials/sweeps/*/figures")
    assert {file.name: file.read_bytes() for file in kept.iterdir()} == files
    assert len(trials(folder)) == TRIALS[name]
    shutil.rmtree(folder / "figures")
    capsys.readouterr()
    with chdir(folder):
        assert main(command(name)) == 0
    assert made_files(folder) == files
    out = capsys.readouterr().out
    assert f"figures/{name}.png" in out
    assert f"{name}: {' '.join(files[f'{name}.md'].decode().split())}" in out


def test_costs_are_those_of_the_trials(made: Callable[[str], Path]) -> None:
    folder = made("fig6")
    numbers = pd.read_csv(folder / "figures" / "fig6.csv")
    assert len(trials(folder)) == numbers.groupby(["cell", "seed"]).ngroups == 4
    for path in trials(folder):
        trial = simbias.load_trial(path)
        own = numbers[numbers["seed"] == trial.study.seed]
        expected = [iteration.hardware_cost for iteration in trial.iterations]
        assert list(own["hardware_cost"]) == pytest.approx(expected, rel=1e-5)


def test_success_rates_are_those_of_experiments_from_the_grid(made: Callable[[str], Path]) -> None:
    """Repeated one by one; jobs change nothing; another grid runs its own experiments, the trials do not."""
    folder = made("fig7")
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
        assert main([*command("fig7"), "sweep.figures.fig7.x.points=2", "engine=sequential"]) == 0
    assert len(batches(folder)) == 2 * len(once)
    assert once.items() < batches(folder).items()
    assert len(trials(folder)) == 4


def test_killed_among_a_figures_experiments(tmp_path: Path) -> None:
    """Nothing that is kept runs again, what was half written does; the figure is as uninterrupted."""
    arguments = [*command("fig7"), "sweep.trials=1", "sweep.figures.fig7.experiments=4"]
    uninterrupted, killed = tmp_path / "uninterrupted", tmp_path / "killed"
    for folder in (uninterrupted, killed):
        folder.mkdir()
    assert run(*arguments, "engine=sequential", folder=uninterrupted)[0] == 0
    total = len(batches(uninterrupted))
    process = start(*arguments, folder=killed)
    until_trials(process, 2 + 2)  # trials, then batches
    process.send_signal(signal.SIGKILL)
    finish(process)
    before = batches(killed)
    assert 2 <= len(before) < total
    first, *others = sorted(before)
    (folder,) = killed.glob("trials/sweeps/*/experiments")
    (folder / first).write_text(before[first][:-9])
    status, out, err = run(*arguments, "engine=sequential", folder=killed)
    assert (status, err) == (0, "")
    assert f"[{len(others) + 1}/{total}]" in out
    assert f"[{len(others)}/{total}]" not in out
    assert batches(killed) == batches(uninterrupted)
    assert made_files(killed) == made_files(uninterrupted)


BREAKING = """
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.core import HardwareError

class Breaking(PymunkBongoboard):
    def run(self, policy, theta, start, rng):
        if start[0] > THRESHOLD:
            raise HardwareError("a leg broke")
        return super().run(policy, theta, start, rng)
"""


def test_hardware_that_breaks_among_a_figures_experiments(tmp_path: Path) -> None:
    """The trials are kept; when the fault is mended, the same command resumes."""
    conf = write_sweep(tmp_path, "none", "sweep: {trials: 1, axes: {}}")
    (conf / "hardware").mkdir()
    noise = "{torque_variance: 0.0, angle_variance: 0.0, velocity_variance: 0.0}"
    (conf / "hardware" / "breaking.yaml").write_text(f"_target_: breaking.Breaking\nnoise: {noise}\n")
    module = tmp_path / "breaking.py"
    arguments = ["--config-dir", "conf", *command("fig7"), "hardware=breaking", "sweep.trials=1"]
    module.write_text(BREAKING.replace("THRESHOLD", "0.2"))
    status, _, err = run(*arguments, folder=tmp_path)
    assert status == 1
    assert "fig7: hardware: a leg broke" in err
    assert "Traceback" not in err
    assert len(trials(tmp_path)) == 2
    module.write_text(BREAKING.replace("THRESHOLD", "9.0"))
    status, out, err = run(*arguments, "engine=sequential", folder=tmp_path)
    assert status == 0
    assert re.fullmatch(r"simbias: .*code that has changed .*\(breaking\).*\n", err)
    assert "= 2, 2 of them finished already" in out


def test_bad_input_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for overrides, key in (
        (["+sweep=fig4", "tracking=none"], "tracking: "),
        (["+sweep=fig4", "sweep.figures.fig4.columns=0"], "sweep.figures.fig4.columns: "),
        (["+sweep=fig4", "+sweep.figures.fig4.colour=red"], "sweep.figures.fig4.colour: "),
        (["+sweep=fig5", "sweep.figures.fig5.states=[alpha_w,alpha_b,x]"], "sweep.figures.fig5: "),
        (
            ["+sweep=fig7", "sweep.figures.fig7.hardware=real"],
            "sweep.figures.fig7: ",
        ),
        (["+sweep=fig7", "sweep.figures.fig7.y.state=z"], "sweep.figures.fig7: "),
        (
            ["+sweep=fig6", "sweep.figures.fig6._target_=simbias.trial.study.Study"],
            "sweep.figures.fig6._target_",
        ),
        (["+sweep=smoke", "+sweep.figures={a/b: {_target_: x.Y}}"], "sweep.figures.a/b"),
    ):
        assert main([*overrides, *MIXED]) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"simbias: {key}"), err
        assert len(err.splitlines()) == 1
        assert not list(tmp_path.iterdir())


def test_figure_without_a_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that needs no trial in full is drawn from the table."""
    monkeypatch.chdir(tmp_path)
    quick = ["task.horizon=200", "optimizer.max_evaluations=20", "engine=sequential"]
    assert main(["+sweep=smoke", *quick, "tracking=none", "+sweep.figures_to=here"]) == 0
    assert {file.name for file in (tmp_path / "here").iterdir()} == {
        f"experiments.{suffix}" for suffix in ("png", "svg", "csv", "md")
    }
