"""All pictures of a trial as files; what it cannot have is left out, and no picture is worth a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from simbias.core.records import Iteration
from simbias.pictures import rejections, save, save_animation
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.trial.comparison import simulated, worst_experiment
from simbias.pictures.trial.gallery import ANIMATION, FIGURES, pictures
from simbias.trial.folder import Withdrawal
from simbias.trial.study import Study

AT_REST = [name for name in FIGURES if name != "following"]  # of a task whose goal does not move


@pytest.mark.slow
def test_all_pictures_of_a_trial(short: Study, trial: list[Iteration]) -> None:
    files = pictures(short, trial)
    assert list(files) == [*(f"{name}.png" for name in AT_REST), "animation.gif"]
    for name, content in files.items():
        assert Image.open(BytesIO(content)).format == name.rpartition(".")[2].upper()
    assert sum(map(len, files.values())) < 1_000_000
    check_animation(short, trial, Image.open(BytesIO(files["animation.gif"])))
    assert pictures(short, []) == {}


def check_animation(short: Study, trial: list[Iteration], picture: Image.Image) -> None:
    """It is in real time and shows all."""
    durations, sizes = [], set()
    for frame in range(picture.n_frames):
        picture.seek(frame)
        durations.append(picture.info["duration"])
        sizes.add(picture.size)
    worst = worst_experiment(trial[-1])
    rollouts = [worst, *simulated(short, trial[-1], [worst])]
    longest = max(rollout.frames for rollout in rollouts) * short.task.time_step
    assert sum(durations[:-1]) == pytest.approx(1000 * longest, abs=100)
    assert len(sizes) == 1
    assert len(picture.convert("RGB").getcolors()) > 10
    assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


@pytest.mark.slow
def test_a_task_without_a_drawing_has_no_animation(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    loose, names = Withdrawal("0004_experiment.npz", "a loose cable", (), 0.0, 0.0), ["costs", "overview"]
    files = pictures(*of_point_mass, [*names, ANIMATION])
    assert list(files) == [f"{name}.png" for name in names]
    marked = pictures(*of_point_mass, names, [loose])
    assert all(marked[name] != files[name] for name in files)
    with pytest.raises(NoPictureError, match="PointMass"):
        save_animation(*of_point_mass, BytesIO())


@pytest.mark.slow
def test_a_method_without_search_has_those_of_the_hardware(
    short: Study, on_hardware: list[Iteration], recwarn: pytest.WarningsRecorder
) -> None:
    files = pictures(short, on_hardware)
    names = ["overview.png", "prediction_errors.png", "forecast.png", "phases.png", "animation.gif"]
    assert list(files) == names
    assert not recwarn.list


def test_a_trial_without_experiments_has_its_costs_alone(short: Study, trial: list[Iteration]) -> None:
    assert pictures(short, [replace(trial[0], experiments=(), learning=None)]).keys() == {"costs.png"}


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
