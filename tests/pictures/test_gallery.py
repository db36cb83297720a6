"""All pictures of a trial as files; what it cannot have is left out, and no picture is worth a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from simbias.core.records import Iteration
from simbias.pictures import overview, save, save_animation
from simbias.pictures.elements.drawing import NoPictureError
from simbias.pictures.elements.style import HARDWARE, SIMULATION
from simbias.pictures.trial.comparison import simulated, worst_experiment
from simbias.pictures.trial.gallery import ANIMATION, FIGURES, pictures
from simbias.trial.folder import Withdrawal
from simbias.trial.study import Study

AT_REST = [name for name in FIGURES if name != "following"]  # of a task whose goal does not move


@pytest.mark.slow
def test_all_pictures_of_a_trial(short: Study, trial: list[Iteration], tmp_path: Path) -> None:
    """The animation is in real time and shows all; the overview is as wide as a README needs it."""
    files = pictures(short, trial)
    assert list(files) == [*(f"{name}.png" for name in AT_REST), "animation.gif"]
    for name, content in files.items():
        assert Image.open(BytesIO(content)).format == name.rpartition(".")[2].upper()
    assert sum(map(len, files.values())) < 1_000_000
    picture, durations, sizes = Image.open(BytesIO(files["animation.gif"])), [], set()
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
    save(overview(short, trial), tmp_path / "overview.png")
    assert (tmp_path / "overview.png").stat().st_size < 200_000
    shown = Image.open(tmp_path / "overview.png").convert("RGB")
    assert shown.width == 1800
    colours = np.array([colour for _, colour in shown.getcolors()])
    for name in (HARDWARE, SIMULATION, "#FFFFFF"):
        wanted = np.array([int(name[i : i + 2], 16) for i in (1, 3, 5)])
        assert np.abs(colours - wanted).max(axis=1).min() < 4


@pytest.mark.slow
def test_a_task_without_a_drawing_has_no_animation(of_point_mass: tuple[Study, list[Iteration]]) -> None:
    """What is withdrawn is marked."""
    loose = Withdrawal("0004_experiment.npz", "a loose cable", (), 0.0, 0.0)
    files, marked = (pictures(*of_point_mass, ["costs", ANIMATION], each) for each in ([], [loose]))
    assert list(files) == list(marked) == ["costs.png"]
    assert marked != files
    with pytest.raises(NoPictureError, match="PointMass"):
        save_animation(*of_point_mass, BytesIO())


@pytest.mark.slow
def test_a_trial_has_pictures_of_what_it_has(
    short: Study, trial: list[Iteration], on_hardware: list[Iteration], recwarn: pytest.WarningsRecorder
) -> None:
    """Without search, those of the hardware; without experiments, its costs alone."""
    assert pictures(short, on_hardware, ["costs", "rejections", "phases"]).keys() == {"phases.png"}
    assert pictures(short, [replace(trial[0], experiments=(), learning=None)]).keys() == {"costs.png"}
    assert pictures(short, []) == {}
    assert not recwarn.list


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
