"""Figures as a person makes them: one command each, from the store, resumable."""

from __future__ import annotations

import json
import re
import shutil
import signal
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from sweeping import artifacts, finish, run, runs, start, until_trials, write_sweep

import simbias
from simbias.__main__ import main
from simbias.sweep.batches import Outcomes
from simbias.sweep.grid import expand

pytestmark = pytest.mark.slow

FAILING = ["task.horizon=4500", "optimizer.max_evaluations=20", "method.max_iterations=2"]
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
MOVING = ("fig4",)


def command(name: str, folder: Path) -> list[str]:
    """An absolute URI: in one process MLflow keeps what a relative one meant at first."""
    small = [*SMALL[name], "tracking.pictures=false"]  # those are of trials
    return [f"+sweep={name}", *small, f"tracking.uri=sqlite:///{folder}/mlflow.db"]


def pieces(folder: Path) -> dict[str, str]:
    """Outcomes of the batches that the parent run keeps, by their files."""
    (parent,) = runs(folder)[0]
    return {file.name: file.read_text() for file in (artifacts(parent) / "figures/experiments").glob("*")}


@pytest.fixture(params=SMALL)
def made(request: pytest.FixtureRequest, folder: Path) -> tuple[str, Path]:
    """A figure's name, and a folder with its sweep's store and files."""
    assert main([*command(request.param, folder), "engine=sequential"]) == 0
    return request.param, folder


def test_files(made: tuple[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    """Beside the store and in it; the same trials give the same files."""
    name, folder = made
    names = {f"{name}{suffix}" for suffix in (".png", ".svg", ".csv", ".md")}
    names |= {f"{name}.gif"} if name in MOVING else set()
    files = {file.name: file.read_bytes() for file in (folder / "figures").iterdir()}
    assert set(files) == names
    assert len(np.unique(np.asarray(Image.open(folder / "figures" / f"{name}.png").convert("L")))) > 20
    assert ET.fromstring(files[f"{name}.svg"]).tag.endswith("svg")
    assert len(pd.read_csv(folder / "figures" / f"{name}.csv")) >= 4
    (parent,) = runs(folder)[0]
    assert parent.info.status == "FINISHED"
    kept = {file.name: file.read_bytes() for file in (artifacts(parent) / "figures").glob(f"{name}.*")}
    assert kept == files
    caption = " ".join(files[f"{name}.md"].decode().split())
    assert caption in parent.data.tags["mlflow.note.content"]
    shutil.rmtree(folder / "figures")
    assert main(command(name, folder)) == 0
    assert {file.name: file.read_bytes() for file in (folder / "figures").iterdir()} == files
    out = capsys.readouterr().out
    assert f"figures/{name}.png" in out
    assert f"{name}: {caption}" in out
    assert len(runs(folder)[1]) == len(expand(command(name, folder)).trials)


def test_costs_are_those_of_the_trials(folder: Path) -> None:
    assert main([*command("fig6", folder), "engine=sequential"]) == 0
    numbers = pd.read_csv("figures/fig6.csv")
    trials = runs(folder)[1]
    assert len(trials) == 4
    for run_ in trials:
        trial = simbias.load_trial(run_.info.run_id, f"sqlite:///{folder}/mlflow.db")
        own = numbers[numbers["seed"] == trial.study.seed]
        expected = [iteration.hardware_cost for iteration in trial.iterations]
        assert list(own["hardware_cost"]) == pytest.approx(expected, rel=1e-5)
        assert set(own["cell"]) == {run_.data.tags["axis.noise"]}


def test_success_rates_are_those_of_experiments_from_the_grid(folder: Path) -> None:
    """Tried again one by one; jobs change nothing; a finer grid runs anew, the trials do not."""
    assert main([*command("fig7", folder), "engine.n_jobs=2"]) == 0
    numbers, once = pd.read_csv("figures/fig7.csv"), pieces(folder)
    assert 2 <= len(once) <= 4  # two policies of each of two cells, once each, if they differ
    assert 0 < numbers["succeeded"].sum() < numbers["experiments"].sum()
    for run_ in runs(folder)[1]:
        trial = simbias.load_trial(run_.info.run_id, f"sqlite:///{folder}/mlflow.db")
        repetition = int(run_.data.tags["repetition"])
        noise = [f"hardware.noise.{key}_variance" for key in ("torque", "angle", "velocity")]
        values = zip(noise, (0.1, 1.6e-5, 1.6e-2), strict=True)
        study = simbias.load([*MIXED, *(f"{key}={value}" for key, value in values)])
        own = numbers[
            (numbers["cell"] == run_.data.tags["axis.noise"]) & (numbers["repetition"] == repetition)
        ]
        rngs = np.random.default_rng(repetition).spawn(len(own))
        for row, rng in zip(own.to_dict("records"), rngs, strict=True):
            x = np.array([row["alpha_w"], row["alpha_b"], *study.task.start_mean[2:]])
            rollout = study.experiment(trial.iterations[-1].parameters, rng, x)
            assert study.cost.passes(rollout) == row["succeeded"]
    assert main([*command("fig7", folder), "sweep.figures.fig7.x.points=2", "engine=sequential"]) == 0
    assert len(pieces(folder)) == 2 * len(once)
    assert once.items() < pieces(folder).items()
    assert len(runs(folder)[1]) == 4


def test_killed_among_a_figures_experiments(folder: Path) -> None:
    """What is kept is not run again, what was half written is, and the end is as if undisturbed."""
    undisturbed = folder / "undisturbed"
    undisturbed.mkdir()
    shutil.copy(folder / "mlflow.db", undisturbed)
    arguments = [*command("fig7", folder)[:-1], "sweep.trials=1", "sweep.figures.fig7.experiments=4"]
    assert run(*arguments, "engine=sequential", folder=undisturbed)[0] == 0
    total = len(pieces(undisturbed))
    process = start(*arguments, folder=folder)
    until_trials(process, 2 + 2)  # trials, then batches
    process.send_signal(signal.SIGKILL)
    finish(process)
    before = pieces(folder)
    assert 2 <= len(before) < total
    first, *others = sorted(before)
    (parent,) = runs(folder)[0]
    (artifacts(parent) / "figures/experiments" / first).write_text(before[first][:-9])
    status, out, err = run(*arguments, "engine=sequential", folder=folder)
    assert (status, err) == (0, "")
    assert f"[{len(others) + 1}/{total}]" in out
    assert f"[{len(others)}/{total}]" not in out
    assert pieces(folder) == pieces(undisturbed)
    for name in ("fig7.csv", "fig7.png", "fig7.md"):
        assert (folder / "figures" / name).read_bytes() == (undisturbed / "figures" / name).read_bytes()


BREAKING = """
from simbias.robots.bongoboard.pymunk import PymunkBongoboard
from simbias.core import HardwareError

class Breaking(PymunkBongoboard):
    def run(self, policy, theta, start, rng):
        if start[0] > THRESHOLD:
            raise HardwareError("a leg broke")
        return super().run(policy, theta, start, rng)
"""


def test_hardware_that_breaks_among_a_figures_experiments(folder: Path) -> None:
    """The trials are kept; when the fault is mended, the same command goes on."""
    conf = write_sweep(folder, "none", "sweep: {trials: 1, axes: {}}")
    (conf / "hardware").mkdir()
    noise = "{torque_variance: 0.0, angle_variance: 0.0, velocity_variance: 0.0}"
    (conf / "hardware" / "breaking.yaml").write_text(f"_target_: breaking.Breaking\nnoise: {noise}\n")
    module = folder / "breaking.py"
    arguments = ["--config-dir", "conf", *command("fig7", folder)[:-1], "hardware=breaking", "sweep.trials=1"]
    module.write_text(BREAKING.replace("THRESHOLD", "0.2"))
    status, _, err = run(*arguments, folder=folder)
    assert status == 1
    assert "simbias: FigureError: fig7: hardware: a leg broke; 2 of 2 trials are done.\nGo on with:" in err
    assert "Traceback" not in err
    assert runs(folder)[0][0].info.status == "FAILED"
    module.write_text(BREAKING.replace("THRESHOLD", "9.0"))
    status, out, err = run(*arguments, "engine=sequential", folder=folder)
    assert status == 0
    assert re.fullmatch(
        r"simbias: 2 of 2 finished trials ran on code that has changed .*\(breaking\); .*\n", err
    )
    assert "= 2, 2 of them finished already" in out
    assert runs(folder)[0][0].info.status == "FINISHED"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+sweep=fig4", "tracking=none"], "none keeps no trials, and sweep.figures.fig4 is"),
        (["+sweep=fig4", "sweep.figures.fig4.columns=0"], "sweep.figures.fig4.columns: must be greater than"),
        (["+sweep=fig4", "+sweep.figures.fig4.colour=red"], "sweep.figures.fig4.colour: no such key"),
        (["+sweep=fig5", "sweep.figures.fig5.states=[alpha_w,alpha_b,x]"], "fig5: the task has no state x"),
        (["+sweep=fig7", "sweep.figures.fig7.hardware=real"], "figures.fig7: the sweep has no cell real"),
        (["+sweep=fig7", "sweep.figures.fig7.y.state=z"], "sweep.figures.fig7: the task has no state z"),
        (["+sweep=fig6", "sweep.figures.fig6._target_=simbias.trial.study.Study"], "not a SweepFigure"),
        (["+sweep=smoke", "+sweep.figures={a/b: {_target_: x.Y}}"], "sweep.figures.a/b"),
    ],
)  # fmt: skip
def test_bad_input_runs_nothing(
    folder: Path, capsys: pytest.CaptureFixture[str], overrides: list[str], message: str
) -> None:
    assert main([*overrides, *MIXED]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1
    assert not (folder / "mlartifacts").exists()


def test_figure_without_a_store(folder: Path) -> None:
    """One that needs no trial in full is drawn from what there is."""
    quick = ["task.horizon=200", "optimizer.max_evaluations=20", "engine=sequential"]
    assert main(["+sweep=smoke", *quick, "tracking=none", "+sweep.figures_to=here"]) == 0
    assert {file.name for file in (folder / "here").iterdir()} == {
        f"experiments.{suffix}" for suffix in ("png", "svg", "csv", "md")
    }


def test_outcomes_travel_as_text() -> None:
    outcomes = Outcomes((0.1 + 0.2, 1e300), (5000, 17), ("", "speed"), (True, False))
    assert Outcomes.from_json(outcomes.as_json()) == outcomes
    for length in range(len(outcomes.as_json())):
        with pytest.raises(json.JSONDecodeError):
            Outcomes.from_json(outcomes.as_json()[:length])
    assert json.loads(outcomes.as_json())["frames"] == [5000, 17]
    with pytest.raises(ValueError, match="not the outcomes"):
        Outcomes.from_json('{"costs": [1.0], "frames": [17], "failures": ["too fast"]}')
