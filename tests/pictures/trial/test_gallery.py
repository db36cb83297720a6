"""All pictures of a trial as files: at its end, in a sweep, from the store; and none is worth a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import OWN_CONF, POINT_MASS
from matplotlib.figure import Figure
from mlflow import MlflowClient
from PIL import Image
from sweeping import QUICK, artifacts, runs

import simbias
from simbias.config.build import build
from simbias.pictures import rejections, save, save_animation
from simbias.pictures.__main__ import main
from simbias.pictures.drawing import NoPictureError
from simbias.pictures.style import png
from simbias.pictures.trial.compared import simulated, worst
from simbias.pictures.trial.gallery import ANIMATION, FIGURES, IN_SWEEPS, pictures
from simbias.records import Iteration
from simbias.study import Study, Unobserved
from simbias.sweep.grid import expand
from simbias.task.bongoboard_drawing import draw, move
from simbias.tracking.store import connect
from simbias.trial import run_trial
from simbias.worker import run_plan


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a store."""
    folder = tmp_path_factory.mktemp("store")
    connect(f"sqlite:///{folder}/mlflow.db", "simbias")
    return folder


@pytest.mark.parametrize("seed", range(3))
def test_moving_is_drawing_anew(short: Study, seed: int) -> None:
    state = np.random.default_rng(seed).normal(0.0, 0.4, 6)
    moved, drawn = Figure(), Figure()
    artists = draw(moved.subplots(), short.task, np.zeros(6), muted=True)
    move(artists, short.task, state)
    draw(drawn.subplots(), short.task, state)
    for figure in (moved, drawn):
        figure.axes[0].set(xlim=(-1, 1), ylim=(-0.2, 1.5))
    assert png(moved) == png(drawn)


def test_animation_is_in_real_time_and_shows_all(short: Study, trial: list[Iteration]) -> None:
    file = BytesIO()
    save_animation(short, trial, file)
    picture = Image.open(file)
    durations, sizes = [], set()
    for frame in range(picture.n_frames):
        picture.seek(frame)
        durations.append(picture.info["duration"])
        sizes.add(picture.size)
    rollouts = [worst(trial[-1]), *simulated(short, trial[-1])]
    longest = max(rollout.frames for rollout in rollouts) * short.task.time_step
    assert sum(durations[:-1]) == pytest.approx(1000 * longest, abs=100)
    assert len(sizes) == 1
    assert len(picture.convert("RGB").getcolors()) > 10
    assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_all_pictures_of_a_trial(short: Study, trial: list[Iteration]) -> None:
    files = pictures(short, trial)
    assert list(files) == [*(f"{name}.png" for name in FIGURES), "animation.gif"]
    for name, content in files.items():
        assert Image.open(BytesIO(content)).format == name.rpartition(".")[2].upper()
    assert {f"{name}.png" for name in IN_SWEEPS} == pictures(short, trial, IN_SWEEPS).keys()
    assert sum(map(len, files.values())) < 1_000_000
    assert pictures(short, []) == {}


def test_a_task_without_a_drawing_has_no_animation(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    files = pictures(*of_point_mass)
    assert files.keys() == {f"{name}.png" for name in FIGURES}
    with pytest.raises(NoPictureError, match="PointMass"):
        save_animation(*of_point_mass, BytesIO())


def test_a_picture_that_fails_is_a_warning_and_a_text(
    short: Study, trial: list[Iteration], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(study: Study, iterations: Sequence[Iteration]) -> Figure:
        raise IndexError("no such panel")

    monkeypatch.setitem(FIGURES, "costs", broken)
    with pytest.warns(RuntimeWarning, match="picture costs: IndexError: no such panel"):
        files = pictures(short, trial, ["costs", "rejections"])
    assert files.keys() == {"costs.txt", "rejections.png"}
    assert b"no such panel" in files["costs.txt"]
    assert ANIMATION not in files


def test_same_figure_gives_the_same_svg(short: Study, trial: list[Iteration], tmp_path: Path) -> None:
    for name in ("one.svg", "two.svg"):
        save(rejections(short, trial), tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_command_line_draws_a_stored_trial(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All of it, as PNG and SVG; and says in one line what cannot be drawn."""
    uri = f"sqlite:///{store}/mlflow.db"
    words = [*POINT_MASS, "optimizer.max_evaluations=40", "method.max_iterations=2", f"tracking.uri={uri}"]
    study = simbias.load(words, OWN_CONF)
    tracked = study.tracking.open(study)
    run_trial(study, tracked, Unobserved(), lambda _: None)
    kept = Path(artifacts(MlflowClient(uri).get_run(tracked.run_id)), "pictures")
    assert {path.name for path in kept.iterdir()} == {f"{name}.png" for name in FIGURES}
    folder = store / "pictures" / "new"
    assert main([tracked.run_id, str(folder), "--uri", uri]) == 0
    assert {p.name for p in folder.iterdir()} == {
        f"{n}{suffix}" for n in FIGURES for suffix in (".png", ".svg")
    }
    assert all(path.read_bytes().startswith(b"<?xml") for path in folder.glob("*.svg"))
    assert "overview.png, overview.svg, " in capsys.readouterr().out
    unfinished = study.tracking.open(study).run_id
    for run_id, folder, message in (
        ("0" * 32, store, "no such run"),
        (unfinished, store, "nothing to draw"),
        (tracked.run_id, store / "mlflow.db", "no folder"),
    ):
        assert main([run_id, str(folder), "--uri", uri]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1


def test_trials_without_pictures(store: Path) -> None:
    uri = f"sqlite:///{store}/mlflow.db"
    words = [*POINT_MASS, "optimizer.max_evaluations=5", "method.max_iterations=1", f"tracking.uri={uri}"]
    study = simbias.load([*words, "tracking.pictures=false"], OWN_CONF)
    assert study.hash == simbias.load(words, OWN_CONF).hash  # the same trial
    tracked = study.tracking.open(study)
    run_trial(study, tracked, Unobserved(), lambda _: None)
    assert not Path(artifacts(MlflowClient(uri).get_run(tracked.run_id)), "pictures").exists()


def test_a_sweeps_worker_draws_and_its_parent_writes(store: Path) -> None:
    """Broken pictures lose no trial."""
    uri = f"sqlite:///{store}/mlflow.db"
    sweep = expand(["+sweep=smoke", *QUICK, f"tracking.uri={uri}", "sweep.trials=1"])
    trial = sweep.trials[0]
    record = run_plan((trial.composition.config, trial.composition.choices))
    assert record.pictures.keys() == {f"{name}.png" for name in IN_SWEEPS}
    assert all(iteration.fitted_bias is None for iteration in record.iterations)
    study = build(trial.composition)
    tracked = study.tracking.open_sweep(sweep, "again")
    tracked.keep(trial, study, replace(record, pictures={"costs.txt": b"Traceback", **record.pictures}))
    (run,) = runs(store)[1]
    assert run.info.status == "FINISHED"
    kept = {path.name: path.read_bytes() for path in (artifacts(run) / "pictures").iterdir()}
    assert kept == {"costs.txt": b"Traceback", **record.pictures}
    tracked.close()
    assert not run_plan((without_pictures(trial.composition.config), trial.composition.choices)).pictures


def without_pictures(config: Any) -> Any:
    return {**config, "tracking": {**config["tracking"], "pictures": False}}
